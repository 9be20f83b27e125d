"""The web application on top of the library."""
