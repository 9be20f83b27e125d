"""The true hand of SynthHDI and how it handles objects."""
