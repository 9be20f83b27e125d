"""What a color means: quantities, color scales and their legend."""
