"""Springs eight at a time in a processor's vector unit.

A node's state, or its adjoint, is a record of eight floats: position, 0, velocity, 0. A group of
eight springs loads the records of their ends, turns them by shuffles so that a register holds
one coordinate of all eight, and works out eight forces with one square root and one division.
Warp's own arrays have strides known only at run time, so its compiler cannot do this by itself;
hence native snippets, in the vector types that Clang has for every processor. The ends of a
spring are given as four times the node, which is where its force begins.

The laws are those of `springs.pull_springs` and `adjoint.springs_adjoint`.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 8
"""Springs in a group; lists are padded to a multiple, by springs without force."""
Record = wp.types.vector(length=8, dtype=wp.float32)
"""Position, 0, velocity, 0 of a node, or the adjoints of both."""


@wp.struct
class Parts:
    """The arrays of a `partition.SpringParts`."""

    own_start: wp.array[wp.int32]
    held_start: wp.array[wp.int32]
    inner_start: wp.array[wp.int32]
    cut_start: wp.array[wp.int32]
    node: wp.array[wp.int32]
    control: wp.array[wp.int32]
    spring: wp.array[wp.int32]
    spoken: wp.array[wp.int32]
    ends: wp.array[wp.vec2i]


@wp.struct
class SpringMaterial:
    """Rest length [m], scaled stiffness [N], damping [N·s/m] of the springs part by part."""

    rest: wp.array[wp.float32]
    elastic: wp.array[wp.float32]
    dashpot: wp.array[wp.float32]


@wp.struct
class Bars:
    """Adjoints in the order of the parts, kept from substep to substep.

    `coefficients` holds each node's share of drag's, restitution's and friction's; `start` and
    `end` are those of the control nodes of each part.
    """

    state: wp.array[Record]
    force: wp.array2d[wp.vec4]
    log_stiffness: wp.array[wp.float32]
    damping: wp.array[wp.float32]
    coefficients: wp.array[wp.vec3]
    start: wp.array[wp.vec3]
    end: wp.array[wp.vec3]


def _each(line: str) -> str:
    """Repeat a line for the eight springs of a group."""
    return "\n".join(line.replace("@", str(lane)) for lane in range(LANES))


# Shuffles act alike on both halves of 128 bits, which costs least; only the last swaps halves.
_OPEN = f"""
#if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(on)
    typedef float lanes __attribute__((vector_size(32), aligned(4)));
    typedef float quad __attribute__((vector_size(16), aligned(4)));
    auto low = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); }};
    auto high = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); }};
    auto first_two = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); }};
    auto last_two = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); }};
    auto fronts = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11); }};
    auto backs = [](lanes a, lanes b) {{
        return __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15); }};
    auto join = [](quad a, quad b) {{
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7); }};
    auto at = [](const float* from) {{ return *(const lanes*)from; }};
    auto quad_at = [](const float* from) {{ return *(const quad*)from; }};
    const float* const now = (const float*)state.data + (size_t)row * 8 * state.shape[1];
    const int last = parts.LIST.data[part + 1];
    for (int g = parts.LIST.data[part]; g < last; g += {LANES}) {{
        const unsigned* const end = (const unsigned*)(parts.ends.data + g);
        {_each("const size_t i@ = end[2 * @], j@ = end[2 * @ + 1];")}
        {_each("const lanes r@ = at(now + 2 * j@) - at(now + 2 * i@);")}
        const lanes xy0 = low(r0, r1), xy1 = low(r2, r3), xy2 = low(r4, r5), xy3 = low(r6, r7);
        const lanes z0 = high(r0, r1), z1 = high(r2, r3), z2 = high(r4, r5), z3 = high(r6, r7);
        const lanes x03 = first_two(xy0, xy1), x47 = first_two(xy2, xy3);
        const lanes y03 = last_two(xy0, xy1), y47 = last_two(xy2, xy3);
        const lanes z03 = first_two(z0, z1), z47 = first_two(z2, z3);
        const lanes dx = fronts(x03, x47), sx = backs(x03, x47);
        const lanes dy = fronts(y03, y47), sy = backs(y03, y47);
        const lanes dz = fronts(z03, z47), sz = backs(z03, z47);
        const lanes length = __builtin_elementwise_sqrt(dx * dx + dy * dy + dz * dz);
        const lanes inverse = 1.0f / __builtin_elementwise_max(length, (lanes){{}} + 1.0e-6f);
        const lanes elastic = at(material.elastic.data + g), dash = at(material.dashpot.data + g);
        const lanes rest_length = at(material.rest.data + g);
        // Stiffness over rest length, rounded beforehand, would shift long trajectories tenfold.
        const lanes strain = (length - rest_length) / rest_length;
        const lanes rate = (dx * sx + dy * sy + dz * sz) * inverse;
        const lanes tension = elastic * strain + dash * rate;
        const lanes by_offset = tension * inverse;
"""
_CLOSE = """
    }
#endif
"""

# A lane taken by its subscript would make the compiler work out each lane by itself.
_PULL = _each(
    """{
            const quad pull = __builtin_shufflevector(by_offset, by_offset, @, @, @, @)
                * __builtin_shufflevector(r@, r@, 0, 1, 2, 3);
            *(quad*)((float*)force.data + i@) += pull;
            if (TO_BOTH) *(quad*)((float*)force.data + j@) -= pull;
        }"""
)

# With f the adjoint of the force on the first end less that on the second, the springs give
# a (x_j - x_i) + b f + c (v_j - v_i) to the offset and c (x_j - x_i) to the stretch.
_RETRACT = f"""
        const float* const bar_now = (const float*)bars.force.data
            + (size_t)(row % 2) * 4 * bars.force.shape[1];
        {_each("const quad f@ = quad_at(bar_now + i@) - quad_at(bar_now + j@);")}
        const lanes f04 = join(f0, f4), f15 = join(f1, f5);
        const lanes f26 = join(f2, f6), f37 = join(f3, f7);
        const lanes fxy0 = low(f04, f15), fxy1 = low(f26, f37);
        const lanes fx = first_two(fxy0, fxy1), fy = last_two(fxy0, fxy1);
        const lanes fz = first_two(high(f04, f15), high(f26, f37));
        const lanes closing = (dx * fx + dy * fy + dz * fz) * inverse;
        *(lanes*)(bars.log_stiffness.data + g) += closing * elastic * strain;
        *(lanes*)(bars.damping.data + g) += closing * rate;
        const lanes b = by_offset, c = dash * closing * inverse;
        const lanes a = (elastic / rest_length * closing - b * closing - c * rate) * inverse;
        const lanes ox = a * dx + b * fx + c * sx, tx = c * dx;
        const lanes oy = a * dy + b * fy + c * sy, ty = c * dy;
        const lanes oz = a * dz + b * fz + c * sz, tz = c * dz;
        const lanes xs = fronts(ox, tx), ys = fronts(oy, ty), zs = fronts(oz, tz);
        const lanes xt = backs(ox, tx), yt = backs(oy, ty), zt = backs(oz, tz), none = {{}};
        const lanes u0 = low(xs, ys), u2 = high(xs, ys), w0 = low(zs, none), w2 = high(zs, none);
        const lanes u4 = low(xt, yt), u6 = high(xt, yt), w4 = low(zt, none), w6 = high(zt, none);
        const lanes m0 = first_two(u0, w0), m1 = last_two(u0, w0);
        const lanes m2 = first_two(u2, w2), m3 = last_two(u2, w2);
        const lanes m4 = first_two(u4, w4), m5 = last_two(u4, w4);
        const lanes m6 = first_two(u6, w6), m7 = last_two(u6, w6);
""" + _each(
    """{
            *(lanes*)((float*)bars.state.data + 2 * i@) -= m@;
            if (TO_BOTH) *(lanes*)((float*)bars.state.data + 2 * j@) += m@;
        }"""
)


def _springs(body: str, *, is_cut: bool) -> str:
    """Loop over one of a part's two lists; a cut spring acts on its first end only."""
    snippet = _OPEN + body.replace("TO_BOTH", "0" if is_cut else "1") + _CLOSE
    return snippet.replace("LIST", "cut_start" if is_cut else "inner_start")


@wp.func_native(snippet=_springs(_PULL, is_cut=False))
def pull_inner(
    part: int,
    row: int,
    parts: Parts,
    material: SpringMaterial,
    state: wp.array2d[Record],
    force: wp.array[wp.vec4],
):
    """Add the forces of the springs within a part, from the states in a row."""


@wp.func_native(snippet=_springs(_PULL, is_cut=True))
def pull_cut(
    part: int,
    row: int,
    parts: Parts,
    material: SpringMaterial,
    state: wp.array2d[Record],
    force: wp.array[wp.vec4],
):
    """Add the forces of the springs across a part's border to its own nodes."""


@wp.func_native(snippet=_springs(_RETRACT, is_cut=False))
def inner_springs_adjoint(
    part: int,
    row: int,
    parts: Parts,
    material: SpringMaterial,
    state: wp.array2d[Record],
    bars: Bars,
):
    """Carry the adjoints of forces to the states of both ends and to the springs' material."""


@wp.func_native(snippet=_springs(_RETRACT, is_cut=True))
def cut_springs_adjoint(
    part: int,
    row: int,
    parts: Parts,
    material: SpringMaterial,
    state: wp.array2d[Record],
    bars: Bars,
):
    """Do the same for the springs across a part's border and its own nodes."""
