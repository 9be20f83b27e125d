"""What an object looks like: Gaussian splats, fitted to a frame and carried by the object's nodes.

`splats` says what they are and `binding` how nodes carry them.
"""
