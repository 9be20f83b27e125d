"""What splats give every pixel, and how that changes with the splats.

A picture is cut into square tiles. Every tile has a list of the splats that reach into it, the
nearest first, and its pixels go through that list alone. Nothing is added with atomics: on the way
back each pixel leaves what it asks of every splat of its list at a place of its own, and then every
splat collects what is at its places, in their order. So the same input gives the same bits on a
device.

Source: B. Kerbl et al., 3D Gaussian Splatting, 2023, whose limits are kept: what widens splats to a
pixel (`BLUR`), the least opacity that counts (`FAINT`), and the least light from behind that is
followed (`DARK`).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE_SIDE = wp.constant(8)
"""Rows and columns of pixels of a tile."""
LEAST_DEPTH = wp.constant(0.01)
"""Splats whose middle has less depth than this are not seen [m]."""
BLUR = wp.constant(0.3)
"""Added to the variance of every splat in the picture [px²]."""
OPAQUE = wp.constant(0.999)
"""Most that a splat covers."""
FAINT = wp.constant(1.0 / 255.0)
"""A splat that covers less than this of a pixel is not seen there."""
DARK = wp.constant(1e-4)
"""A pixel is done before the splat that would let through less than this."""
_MARGIN = wp.constant(0.3)
"""Part of half the picture's width by which splats beyond its border are taken to be at most."""
_SLACK = wp.constant(0.01)
"""How far beyond a splat's reach a tile still lists it, so that rounding decides nothing [px]."""


@wp.struct
class Pinhole:
    """A pinhole camera."""

    rotation: wp.mat33
    """From the world's axes to the camera's: x right, y down, z forward."""
    translation: wp.vec3
    """Of the world's origin in the camera's axes [m]."""
    focal: wp.vec3
    """K[0, 0], K[0, 1] and K[1, 1] [px]."""
    middle: wp.vec2
    """Where the camera's axis meets the picture [px]."""
    size: wp.vec2i
    """Columns and rows [px]."""


@wp.func
def _limited(slope: wp.float32, focal: wp.float32, middle: wp.float32, size: wp.int32):
    """Keep a splat beyond the border from being drawn out without bounds."""
    beyond = _MARGIN * 0.5 * wp.float32(size) / focal
    # Pixel centres are whole, so the border is half a pixel before the first one.
    low = (middle + 0.5) / focal + beyond
    high = (wp.float32(size) - middle - 0.5) / focal + beyond
    return wp.min(high, wp.max(-low, slope))


@wp.kernel(enable_backward=True)
def project_splats(
    lens: Pinhole,
    # Splats
    center: wp.array[wp.vec3],
    scale: wp.array[wp.float32],
    # In the picture
    middle_out: wp.array[wp.vec2],
    conic_out: wp.array[wp.vec3],
    depth_out: wp.array[wp.float32],
):
    splat = wp.tid()
    place = lens.rotation * center[splat] + lens.translation
    depth = place[2]
    depth_out[splat] = depth
    if depth > LEAST_DEPTH:
        x = place[0] / depth
        y = place[1] / depth
        middle_out[splat] = wp.vec2(
            lens.focal[0] * x + lens.focal[1] * y + lens.middle[0],
            lens.focal[2] * y + lens.middle[1],
        )
        x = _limited(x, lens.focal[0], lens.middle[0], lens.size[0])
        y = _limited(y, lens.focal[2], lens.middle[1], lens.size[1])
        across = wp.vec3(lens.focal[0], lens.focal[1], -(lens.focal[0] * x + lens.focal[1] * y))
        down = wp.vec3(0.0, lens.focal[2], -lens.focal[2] * y)
        size = scale[splat] / depth
        # The covariance [px²] is a, b; b, c.
        a = size * size * wp.dot(across, across) + BLUR
        b = size * size * wp.dot(across, down)
        c = size * size * wp.dot(down, down) + BLUR
        determinant = a * c - b * b
        conic_out[splat] = wp.vec3(c / determinant, -b / determinant, a / determinant)


@wp.kernel
def reach_tiles(
    # Splats in the picture
    middle: wp.array[wp.vec2],
    conic: wp.array[wp.vec3],
    depth: wp.array[wp.float32],
    opacity: wp.array[wp.float32],
    # Tiles
    columns: wp.int32,
    rows: wp.int32,
    # First column, first row, columns and rows of tiles, and their number
    box_out: wp.array[wp.vec4i],
    count_out: wp.array[wp.int32],
):
    splat = wp.tid()
    box_out[splat] = wp.vec4i(0, 0, 0, 0)
    count_out[splat] = 0
    if depth[splat] <= LEAST_DEPTH or opacity[splat] <= FAINT:
        return
    # Where half of the squared distance, in standard deviations, is at most this, it is seen.
    limit = 2.0 * wp.log(opacity[splat] / FAINT)
    form = conic[splat]
    determinant = form[0] * form[2] - form[1] * form[1]
    across = wp.sqrt(limit * form[2] / determinant) + _SLACK
    down = wp.sqrt(limit * form[0] / determinant) + _SLACK
    place = middle[splat]
    side = wp.float32(TILE_SIDE)
    right = wp.float32(columns)
    bottom = wp.float32(rows)
    x0 = wp.clamp(wp.floor(wp.ceil(place[0] - across) / side), 0.0, right)
    x1 = wp.clamp(wp.floor(wp.floor(place[0] + across) / side) + 1.0, 0.0, right)
    y0 = wp.clamp(wp.floor(wp.ceil(place[1] - down) / side), 0.0, bottom)
    y1 = wp.clamp(wp.floor(wp.floor(place[1] + down) / side) + 1.0, 0.0, bottom)
    if x1 > x0 and y1 > y0:
        box = wp.vec4i(wp.int32(x0), wp.int32(y0), wp.int32(x1 - x0), wp.int32(y1 - y0))
        box_out[splat] = box
        count_out[splat] = box[2] * box[3]


@wp.kernel
def list_reached(
    box: wp.array[wp.vec4i],
    depth: wp.array[wp.float32],
    first: wp.array[wp.int32],
    columns: wp.int32,
    # Lists: tile and depth, and the place before they are sorted
    key_out: wp.array[wp.int64],
    slot_out: wp.array[wp.int32],
    splat_out: wp.array[wp.int32],
):
    splat = wp.tid()
    # Positive floats are in the order of their bits.
    bits = wp.int64(wp.cast(depth[splat], wp.int32))
    area = box[splat]
    slot = first[splat]
    for row in range(area[1], area[1] + area[3]):
        for column in range(area[0], area[0] + area[2]):
            tile = wp.int64(row * columns + column)
            key_out[slot] = (tile << wp.int64(32)) | bits
            slot_out[slot] = slot
            splat_out[slot] = splat
            slot += 1


@wp.kernel
def find_lists(
    count: wp.int32,
    key: wp.array[wp.int64],
    slot: wp.array[wp.int32],
    splat: wp.array[wp.int32],
    # Sorted lists: splat at each place, place of each slot, and where tiles begin and end
    listed_out: wp.array[wp.int32],
    place_out: wp.array[wp.int32],
    begin_out: wp.array[wp.int32],
    end_out: wp.array[wp.int32],
):
    place = wp.tid()
    listed_out[place] = splat[slot[place]]
    place_out[slot[place]] = place
    tile = wp.int32(key[place] >> wp.int64(32))
    if place == 0 or wp.int32(key[place - 1] >> wp.int64(32)) != tile:
        begin_out[tile] = place
    if place == count - 1 or wp.int32(key[place + 1] >> wp.int64(32)) != tile:
        end_out[tile] = place + 1


@wp.func
def _distance(conic: wp.vec3, x: wp.float32, y: wp.float32) -> wp.float32:
    """Give half of the squared distance from a splat's middle, in standard deviations."""
    return 0.5 * (conic[0] * x * x + conic[2] * y * y) + conic[1] * x * y


@wp.kernel
def blend_splats(
    columns: wp.int32,
    begin: wp.array[wp.int32],
    end: wp.array[wp.int32],
    listed: wp.array[wp.int32],
    # Splats in the picture
    middle: wp.array[wp.vec2],
    conic: wp.array[wp.vec3],
    depth: wp.array[wp.float32],
    color: wp.array[wp.vec3],
    opacity: wp.array[wp.float32],
    # What is behind them, and how far it is; 0 where that does not matter
    background: wp.array2d[wp.vec3],
    occluder: wp.array2d[wp.float32],
    # Pixels: color over the background, what is covered, and mean depth of what covers
    color_out: wp.array2d[wp.vec3],
    alpha_out: wp.array2d[wp.float32],
    depth_out: wp.array2d[wp.float32],
):
    tile, inner = wp.tid()
    row = TILE_SIDE * (tile // columns) + inner // TILE_SIDE
    column = TILE_SIDE * (tile % columns) + inner % TILE_SIDE
    if row >= color_out.shape[0] or column >= color_out.shape[1]:
        return
    x = wp.float32(column)
    y = wp.float32(row)
    limit = occluder[row, column]
    light = wp.float32(1.0)
    total = wp.vec3(0.0, 0.0, 0.0)
    distance = wp.float32(0.0)
    place = begin[tile]
    last = end[tile]
    while place < last:
        splat = listed[place]
        place += 1
        away = depth[splat]
        if limit > 0.0 and away > limit:
            break
        at = middle[splat]
        strength = opacity[splat] * wp.exp(-_distance(conic[splat], x - at[0], y - at[1]))
        cover = wp.min(strength, OPAQUE)
        if cover >= FAINT:
            rest = light * (1.0 - cover)
            if rest <= DARK:
                break
            share = light * cover
            total += share * color[splat]
            distance += share * away
            light = rest
    color_out[row, column] = total + light * background[row, column]
    alpha = 1.0 - light
    alpha_out[row, column] = alpha
    if alpha > 0.0:
        depth_out[row, column] = distance / alpha
    else:
        depth_out[row, column] = 0.0


@wp.kernel
def ask_splats(
    columns: wp.int32,
    begin: wp.array[wp.int32],
    end: wp.array[wp.int32],
    listed: wp.array[wp.int32],
    # Splats in the picture
    middle: wp.array[wp.vec2],
    conic: wp.array[wp.vec3],
    depth: wp.array[wp.float32],
    color: wp.array[wp.vec3],
    opacity: wp.array[wp.float32],
    background: wp.array2d[wp.vec3],
    occluder: wp.array2d[wp.float32],
    # Pixels, and the slope of the loss with each
    alpha: wp.array2d[wp.float32],
    mean_depth: wp.array2d[wp.float32],
    picture: wp.array2d[wp.vec3],
    color_slope: wp.array2d[wp.vec3],
    alpha_slope: wp.array2d[wp.float32],
    depth_slope: wp.array2d[wp.float32],
    # For each place of a list and pixel of its tile: share in the pixel, and slope of the loss
    # with the logarithm of the splat's strength there; 0 where it is not seen
    share_out: wp.array2d[wp.vec2],
):
    tile, inner = wp.tid()
    row = TILE_SIDE * (tile // columns) + inner // TILE_SIDE
    column = TILE_SIDE * (tile % columns) + inner % TILE_SIDE
    place = begin[tile]
    last = end[tile]
    if row < picture.shape[0] and column < picture.shape[1] and alpha[row, column] > 0.0:
        x = wp.float32(column)
        y = wp.float32(row)
        limit = occluder[row, column]
        ground = background[row, column]
        tint = color_slope[row, column]
        # A unit of weight of a splat at depth z brings tint . color + offset + far * z.
        far = depth_slope[row, column] / alpha[row, column]
        offset = alpha_slope[row, column] - wp.dot(tint, ground) - far * mean_depth[row, column]
        # What all splats together bring.
        behind = (
            wp.dot(tint, picture[row, column] - ground)
            + alpha[row, column] * (alpha_slope[row, column])
        )
        light = wp.float32(1.0)
        while place < last:
            splat = listed[place]
            away = depth[splat]
            if limit > 0.0 and away > limit:
                break
            at = middle[splat]
            strength = opacity[splat] * wp.exp(-_distance(conic[splat], x - at[0], y - at[1]))
            cover = wp.min(strength, OPAQUE)
            share = wp.float32(0.0)
            slope = wp.float32(0.0)
            if cover >= FAINT:
                rest = light * (1.0 - cover)
                if rest <= DARK:
                    break
                share = light * cover
                value = wp.dot(tint, color[splat]) + offset + far * away
                behind -= share * value
                if strength < OPAQUE:
                    slope = cover * (light * value - behind / (1.0 - cover))
                light = rest
            share_out[place, inner] = wp.vec2(share, slope)
            place += 1
    while place < last:
        share_out[place, inner] = wp.vec2(0.0, 0.0)
        place += 1


@wp.struct
class Slopes:
    """Derivatives of the loss with respect to a splat in the picture."""

    middle: wp.vec2
    """With respect to its place [1/px]."""
    conic: wp.vec3
    """With respect to its inverse covariance [px²]."""
    depth: wp.float32
    """With respect to its depth [1/m]."""
    color: wp.vec3
    """With respect to its color."""
    strength: wp.float32
    """With respect to the logarithm of its opacity."""


@wp.kernel
def collect_in_tiles(
    columns: wp.int32,
    listed: wp.array[wp.int32],
    key: wp.array[wp.int64],
    middle: wp.array[wp.vec2],
    conic: wp.array[wp.vec3],
    alpha: wp.array2d[wp.float32],
    color_slope: wp.array2d[wp.vec3],
    depth_slope: wp.array2d[wp.float32],
    share: wp.array2d[wp.vec2],
    slopes_out: wp.array[Slopes],
):
    place = wp.tid()
    splat = listed[place]
    tile = wp.int32(key[place] >> wp.int64(32))
    top = TILE_SIDE * (tile // columns)
    left = TILE_SIDE * (tile % columns)
    at = middle[splat]
    form = conic[splat]
    strength = wp.float32(0.0)
    first = wp.vec2(0.0, 0.0)
    second = wp.vec3(0.0, 0.0, 0.0)
    tint = wp.vec3(0.0, 0.0, 0.0)
    far = wp.float32(0.0)
    for inner in range(TILE_SIDE * TILE_SIDE):
        asked = share[place, inner]
        if asked[0] > 0.0:
            row = top + inner // TILE_SIDE
            column = left + inner % TILE_SIDE
            slope = asked[1]
            x = wp.float32(column) - at[0]
            y = wp.float32(row) - at[1]
            strength += slope
            first += slope * wp.vec2(x, y)
            second += slope * wp.vec3(x * x, x * y, y * y)
            tint += asked[0] * color_slope[row, column]
            far += asked[0] * depth_slope[row, column] / alpha[row, column]
    slopes = Slopes()
    slopes.strength = strength
    slopes.middle = wp.vec2(
        form[0] * first[0] + form[1] * first[1], form[1] * first[0] + form[2] * first[1]
    )
    slopes.conic = wp.vec3(-0.5 * second[0], -second[1], -0.5 * second[2])
    slopes.color = tint
    slopes.depth = far
    slopes_out[place] = slopes


@wp.kernel
def collect_in_splats(
    first: wp.array[wp.int32],
    count: wp.array[wp.int32],
    place: wp.array[wp.int32],
    opacity: wp.array[wp.float32],
    slopes: wp.array[Slopes],
    middle_out: wp.array[wp.vec2],
    conic_out: wp.array[wp.vec3],
    depth_out: wp.array[wp.float32],
    color_out: wp.array[wp.vec3],
    opacity_out: wp.array[wp.float32],
):
    splat = wp.tid()
    middle = wp.vec2(0.0, 0.0)
    conic = wp.vec3(0.0, 0.0, 0.0)
    depth = wp.float32(0.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    strength = wp.float32(0.0)
    for slot in range(first[splat], first[splat] + count[splat]):
        part = slopes[place[slot]]
        middle += part.middle
        conic += part.conic
        depth += part.depth
        color += part.color
        strength += part.strength
    middle_out[splat] = middle
    conic_out[splat] = conic
    depth_out[splat] = depth
    color_out[splat] = color
    if opacity[splat] > 0.0:
        opacity_out[splat] = strength / opacity[splat]
    else:
        opacity_out[splat] = 0.0
