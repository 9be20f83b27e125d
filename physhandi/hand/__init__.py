"""The articulated hand."""
