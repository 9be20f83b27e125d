"""What is damaged or was left behind in a data folder, and how it is mended."""
