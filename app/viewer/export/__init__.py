"""Exports of what is on the screen: pictures, geometry, tables and bundles."""
