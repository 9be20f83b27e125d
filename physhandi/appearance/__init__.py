"""Appearance of an object: Gaussian splats, fitted to a frame and carried by the object's nodes.

`splats` says what they are, `binding` how nodes carry them, `rasterise` draws them, `picture` with
the hands that hold the object. `fit` fits them to what views `recorded`, through `differentiable`.
"""
