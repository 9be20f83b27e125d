"""Pictures, depth and labels of simple shapes, without a browser or a graphics card.

`shapes` says what can be drawn, `renderer` draws it: `rasterize` tells what the centre of every
pixel sees, exactly (depth, shape, place on it), as made-up recordings need; `render` gives an
antialiased picture, as exports and previews do. Cameras are those of `physhandi.data.camera`,
without distortion. The same input gives the same bits.
"""
