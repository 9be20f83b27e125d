"""Which shape every sample of a picture sees, and what color that gives.

Samples are rays through the camera's pinhole, on a grid. A triangle or ball asks those within its
bounds, so no search structure is built: for whole pictures this is far less work than tracing each
ray through a hierarchy of bounds. A sample keeps the least of all integers that join depth and
number of a shape, so the order of threads does not matter. Products and sums stay apart for the
same bits on all processors.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOTHING = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
"""Of a sample that sees no shape."""
_EDGE = wp.constant(wp.float64(1e-9))
"""How far outside of a triangle a sample still counts, so that no seam is left [px]."""


@wp.struct
class Grid:
    """A part of a picture's samples, whose centres have whole coordinates."""

    K: wp.mat33d
    """Camera matrix of the samples."""
    inverse: wp.mat33d
    """Its inverse."""
    near: wp.float64
    """Least depth that is seen."""
    left: wp.int32
    """First column."""
    right: wp.int32
    """Column after the last one."""
    top: wp.int32
    """First row."""
    bottom: wp.int32
    """Row after the last one."""


@wp.struct
class Shapes:
    """Numbered triangles and then balls, in the camera's axes."""

    corner: wp.array2d[wp.vec3d]
    """Of triangles: sample x times depth, sample y times depth, and depth."""
    corner_color: wp.array2d[wp.vec3]
    """Colors of corners; on images the place in the image, from 0 to 1."""
    image: wp.array[wp.vec3i]
    """First texel, columns and rows of a triangle's image; no columns where none is."""
    texel: wp.array[wp.vec3ub]
    """Pixels of all images."""
    center: wp.array[wp.vec3d]
    """Middles of balls."""
    radius: wp.array[wp.float64]
    """Radii of balls."""
    ball_color: wp.array[wp.vec3]
    """Colors of balls."""
    ball_shading: wp.array[wp.float32]
    """How much darker balls are on the side away from the light."""
    light: wp.vec3d
    """Direction from which the light comes."""


@wp.func
def _key(depth: wp.float64, number: wp.int32) -> wp.int64:
    # Positive floats are in the order of their bits.
    bits = wp.cast(wp.float32(depth), wp.int32)
    return (wp.int64(bits) << wp.int64(32)) | wp.int64(number)


@wp.func
def _number(key: wp.int64) -> wp.int32:
    return wp.int32(key & wp.int64(0x7FFFFFFF))


@wp.func
def _whole(value: wp.float64, low: wp.int32, high: wp.int32) -> wp.int32:
    """Round down and limit; the limits come first, as not every float is an integer."""
    return wp.int32(wp.clamp(wp.floor(value), wp.float64(low), wp.float64(high)))


@wp.func
def _least(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64:
    return wp.min(wp.min(a, b), c)


@wp.kernel
def cover_triangles(
    # Shapes: some of the triangles
    corner: wp.array2d[wp.vec3d],
    first_number: wp.int32,
    # Samples
    grid: Grid,
    band: wp.int32,
    # Nearest
    key_out: wp.array2d[wp.int64],
):
    triangle, part = wp.tid()
    a = corner[triangle, 0]
    b = corner[triangle, 1]
    c = corner[triangle, 2]
    top = grid.top + part * band
    bottom = wp.min(top + band, grid.bottom) - 1
    left = grid.left
    right = grid.right - 1
    x0 = wp.float64(0.0)
    y0 = wp.float64(0.0)
    if a[2] >= grid.near and b[2] >= grid.near and c[2] >= grid.near:
        y0 = wp.ceil(_least(a[1] / a[2], b[1] / b[2], c[1] / c[2]) - _EDGE)
        high = -_least(-a[1] / a[2], -b[1] / b[2], -c[1] / c[2]) + _EDGE
        if high < wp.float64(top) or y0 > wp.float64(bottom):
            return
        top = _whole(y0, top, bottom)
        bottom = _whole(high, top - 1, bottom)
        x0 = wp.ceil(_least(a[0] / a[2], b[0] / b[2], c[0] / c[2]) - _EDGE)
        high = -_least(-a[0] / a[2], -b[0] / b[2], -c[0] / c[2]) + _EDGE
        if high < wp.float64(left) or x0 > wp.float64(right):
            return
        left = _whole(x0, left, right)
        right = _whole(high, left - 1, right)
    # Coordinates count from a sample at the triangle on, so that few digits are lost.
    a = wp.vec3d(a[0] - x0 * a[2], a[1] - y0 * a[2], a[2])
    b = wp.vec3d(b[0] - x0 * b[2], b[1] - y0 * b[2], b[2])
    c = wp.vec3d(c[0] - x0 * c[2], c[1] - y0 * c[2], c[2])
    # A corner's weight at a sample (x, y) is edge . (x, y, 1) over the sum of all three.
    edge_a = wp.cross(b, c)
    edge_b = wp.cross(c, a)
    edge_c = wp.cross(a, b)
    volume = wp.dot(a, edge_a)
    if volume == wp.float64(0.0):
        return
    if volume < wp.float64(0.0):
        volume = -volume
        edge_a = -edge_a
        edge_b = -edge_b
        edge_c = -edge_c
    total = edge_a + edge_b + edge_c
    ahead = wp.vec3d(-total[0], -total[1], volume / grid.near - total[2])
    number = first_number + triangle
    for row in range(top, bottom + 1):
        y = wp.float64(row) - y0
        low = wp.float64(left) - x0
        high = wp.float64(right) - x0
        for side in range(4):
            edge = ahead
            if side == 0:
                edge = edge_a
            elif side == 1:
                edge = edge_b
            elif side == 2:
                edge = edge_c
            slope = edge[0]
            rest = edge[1] * y + edge[2] + _EDGE * (wp.abs(slope) + wp.abs(edge[1]))
            if slope > wp.float64(0.0):
                low = wp.max(low, wp.ceil(-rest / slope))
            elif slope < wp.float64(0.0):
                high = wp.min(high, wp.floor(-rest / slope))
            elif rest < wp.float64(0.0):
                high = low - wp.float64(1.0)
        if low <= high:
            for column in range(wp.int32(low + x0), wp.int32(high + x0) + 1):
                x = wp.float64(column) - x0
                size = total[0] * x + total[1] * y + total[2]
                if size > wp.float64(0.0):
                    key = _key(volume / size, number)
                    wp.atomic_min(key_out, row - grid.top, column - grid.left, key)


@wp.func
def _reach(ahead: wp.float64, across: wp.float64, radius: wp.float64) -> wp.vec2d:
    """Find the least and greatest tangent of the angles at which a ball is seen."""
    size = ahead * ahead - radius * radius
    middle = across * ahead
    half = radius * wp.sqrt(across * across + size)
    return wp.vec2d((middle - half) / size, (middle + half) / size)


@wp.func
def _ball_depth(center: wp.vec3d, radius: wp.float64, ray: wp.vec3d) -> wp.float64:
    """Find where a ray of depth one meets a ball first; negative if it does not."""
    along = wp.dot(ray, center)
    size = wp.dot(ray, ray)
    # The offset from the ray loses fewer digits than a difference of squares.
    offset = center - ray * (along / size)
    within = radius * radius - wp.dot(offset, offset)
    if within < wp.float64(0.0):
        return wp.float64(-1.0)
    return (along - wp.sqrt(within * size)) / size


@wp.kernel
def cover_balls(
    # Shapes
    center: wp.array[wp.vec3d],
    radius: wp.array[wp.float64],
    first_number: wp.int32,
    # Samples
    grid: Grid,
    band: wp.int32,
    # Nearest
    key_out: wp.array2d[wp.int64],
):
    ball, part = wp.tid()
    place = center[ball]
    size = radius[ball]
    if place[2] - size <= grid.near:
        return
    across = _reach(place[2], place[0], size)
    down = _reach(place[2], place[1], size)
    skew = grid.K[0, 1]
    x_low = grid.K[0, 0] * across[0] + wp.min(skew * down[0], skew * down[1]) + grid.K[0, 2]
    x_high = grid.K[0, 0] * across[1] + wp.max(skew * down[0], skew * down[1]) + grid.K[0, 2]
    y_low = grid.K[1, 1] * down[0] + grid.K[1, 2]
    y_high = grid.K[1, 1] * down[1] + grid.K[1, 2]
    top = grid.top + part * band
    bottom = wp.min(top + band, grid.bottom) - 1
    if y_high < wp.float64(top) or y_low > wp.float64(bottom):
        return
    if x_high < wp.float64(grid.left) or x_low > wp.float64(grid.right - 1):
        return
    top = _whole(wp.ceil(y_low), top, bottom)
    bottom = _whole(y_high, top - 1, bottom)
    left = _whole(wp.ceil(x_low), grid.left, grid.right - 1)
    right = _whole(x_high, left - 1, grid.right - 1)
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            ray = grid.inverse * wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
            depth = _ball_depth(place, size, ray)
            if depth > wp.float64(0.0):
                key = _key(depth, first_number + ball)
                wp.atomic_min(key_out, row - grid.top, column - grid.left, key)


@wp.func
def _weights(corner: wp.array2d[wp.vec3d], triangle: wp.int32, x: wp.float64, y: wp.float64):
    """Weigh a triangle's corners at a sample; on the surface, not in the picture."""
    a = corner[triangle, 0]
    b = corner[triangle, 1]
    c = corner[triangle, 2]
    a = wp.vec3d(a[0] - x * a[2], a[1] - y * a[2], a[2])
    b = wp.vec3d(b[0] - x * b[2], b[1] - y * b[2], b[2])
    c = wp.vec3d(c[0] - x * c[2], c[1] - y * c[2], c[2])
    weight = wp.vec3d(
        b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0], a[0] * b[1] - a[1] * b[0]
    )
    return weight / (weight[0] + weight[1] + weight[2])


@wp.kernel
def describe_samples(
    shapes: Shapes,
    # Samples
    grid: Grid,
    key: wp.array2d[wp.int64],
    # What they see
    depth_out: wp.array2d[wp.float64],
    number_out: wp.array2d[wp.int32],
    weight_out: wp.array2d[wp.vec3d],
):
    row, column = wp.tid()
    if key[row, column] == NOTHING:
        return
    number = _number(key[row, column])
    x = wp.float64(column + grid.left)
    y = wp.float64(row + grid.top)
    number_out[row, column] = number
    triangle_count = shapes.corner.shape[0]
    if number < triangle_count:
        weight = _weights(shapes.corner, number, x, y)
        weight_out[row, column] = weight
        depth_out[row, column] = (
            weight[0] * shapes.corner[number, 0][2]
            + weight[1] * shapes.corner[number, 1][2]
            + weight[2] * shapes.corner[number, 2][2]
        )
    else:
        ball = number - triangle_count
        ray = grid.inverse * wp.vec3d(x, y, wp.float64(1.0))
        depth_out[row, column] = _ball_depth(shapes.center[ball], shapes.radius[ball], ray)


@wp.func
def _texel(image: wp.vec3i, u: wp.float32, v: wp.float32, texel: wp.array[wp.vec3ub]) -> wp.vec3:
    """Read an image between its pixels."""
    columns = image[1]
    rows = image[2]
    x = wp.clamp(u * wp.float32(columns) - 0.5, 0.0, wp.float32(columns - 1))
    y = wp.clamp(v * wp.float32(rows) - 0.5, 0.0, wp.float32(rows - 1))
    left = wp.int32(x)
    top = wp.int32(y)
    right = wp.min(left + 1, columns - 1)
    bottom = wp.min(top + 1, rows - 1)
    across = x - wp.float32(left)
    down = y - wp.float32(top)
    value = wp.vec3(0.0, 0.0, 0.0)
    for place in range(4):
        column = left
        row = top
        share = (1.0 - across) * (1.0 - down)
        if place == 1:
            column = right
            share = across * (1.0 - down)
        elif place == 2:
            row = bottom
            share = (1.0 - across) * down
        elif place == 3:
            column = right
            row = bottom
            share = across * down
        one = texel[image[0] + row * columns + column]
        value += share * wp.vec3(wp.float32(one[0]), wp.float32(one[1]), wp.float32(one[2]))
    return value


@wp.func
def _color(shapes: Shapes, grid: Grid, number: wp.int32, row: wp.int32, column: wp.int32):
    """Give the color of a shape at a sample."""
    x = wp.float64(column + grid.left)
    y = wp.float64(row + grid.top)
    triangle_count = shapes.corner.shape[0]
    if number >= triangle_count:
        ball = number - triangle_count
        shading = shapes.ball_shading[ball]
        if shading == 0.0:
            return shapes.ball_color[ball]
        ray = grid.inverse * wp.vec3d(x, y, wp.float64(1.0))
        depth = _ball_depth(shapes.center[ball], shapes.radius[ball], ray)
        normal = (depth * ray - shapes.center[ball]) / shapes.radius[ball]
        facing = wp.float32(wp.dot(normal, shapes.light))
        return shapes.ball_color[ball] * (1.0 - 0.5 * shading * (1.0 - facing))
    first = shapes.corner_color[number, 0]
    second = shapes.corner_color[number, 1]
    third = shapes.corner_color[number, 2]
    if first == second and second == third:
        return first
    exact = _weights(shapes.corner, number, x, y)
    weight = wp.vec3(wp.float32(exact[0]), wp.float32(exact[1]), wp.float32(exact[2]))
    value = weight[0] * first + weight[1] * second + weight[2] * third
    if shapes.image[number][1] > 0:
        return _texel(shapes.image[number], value[0], value[1], shapes.texel)
    return value


@wp.kernel
def color_pixels(
    shapes: Shapes,
    # Samples: one layer of all solid shapes, then one for each sheer one
    grid: Grid,
    key: wp.array3d[wp.int64],
    opacity: wp.array[wp.float32],
    samples: wp.int32,
    background: wp.vec4ub,
    # Pixels: red, green, blue and opacity
    color_out: wp.array3d[wp.uint8],
):
    row, column = wp.tid()
    behind = wp.float32(background[3]) / 255.0
    ground = behind * wp.vec3(
        wp.float32(background[0]), wp.float32(background[1]), wp.float32(background[2])
    )
    total = wp.vec3(0.0, 0.0, 0.0)
    covered = wp.float32(0.0)
    for y in range(row * samples, (row + 1) * samples):
        for x in range(column * samples, (column + 1) * samples):
            limit = key[0, y, x]
            value = ground
            cover = behind
            if limit != NOTHING:
                value = _color(shapes, grid, _number(limit), y, x)
                cover = wp.float32(1.0)
            for _ in range(1, key.shape[0]):
                # The farthest of the sheer shapes that are nearer than the last one.
                layer = wp.int32(0)
                farthest = wp.int64(0)
                for other in range(1, key.shape[0]):
                    one = key[other, y, x]
                    if one < limit and one > farthest:
                        layer = other
                        farthest = one
                if layer > 0:
                    share = opacity[layer]
                    over = _color(shapes, grid, _number(farthest), y, x)
                    value = share * over + (1.0 - share) * value
                    cover = share + (1.0 - share) * cover
                    limit = farthest
            total += value
            covered += cover
    # Colors are weighted by the opacity: clear places are black, not dark.
    scale = wp.float32(0.0)
    if covered > 0.0:
        scale = 1.0 / covered
    for channel in range(3):
        shown = wp.clamp(total[channel] * scale, 0.0, 255.0)
        color_out[row, column, channel] = wp.uint8(shown + 0.5)
    part = 255.0 * covered / wp.float32(samples * samples)
    color_out[row, column, 3] = wp.uint8(part + 0.5)
