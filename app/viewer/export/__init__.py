"""What leaves from the screen: pictures, geometry, tables and bundles."""
