"""The soft bodies of SynthHDI and what they are made of."""
