"""CUDA operations within and between thread blocks that Warp lacks; none of them runs on a CPU."""

import warp as wp

SHARED_SLOTS = 2816
"""Vectors of four floats in a block's 48 KiB of static shared memory, less what Warp takes."""

_BARRIER = """
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""

_SHARED = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 slots[COUNT];
    if (is_write) {
        slots[slot] = make_float4(value[0], value[1], value[2], value[3]);
        return value;
    }
    const float4 found = slots[slot];
    return wp::vec4(found.x, found.y, found.z, found.w);
#else
    return value;
#endif
""".replace("COUNT", str(SHARED_SLOTS))

# A kernel asks for dynamic shared memory by its tiles; the first one begins where this does.
_LARGE_READ = """
#if defined(__CUDA_ARCH__)
    extern __shared__ float4 large_slots[];
    const float4 found = large_slots[slot];
    return wp::vec3(found.x, found.y, found.z);
#else
    return wp::vec3();
#endif
"""
_LARGE_WRITE = """
#if defined(__CUDA_ARCH__)
    extern __shared__ float4 large_slots[];
    large_slots[slot] = make_float4(value[0], value[1], value[2], 0.0f);
#endif
"""

# A 16-byte access is one transaction: whoever sees the tag sees the three floats before it too,
# so blocks can wait for each other's values without a barrier or a fence.
_PUBLISH = """
#if defined(__CUDA_ARCH__)
    unsigned long long low = (unsigned long long)__float_as_uint(value[0])
        | ((unsigned long long)__float_as_uint(value[1]) << 32);
    unsigned long long high = (unsigned long long)__float_as_uint(value[2])
        | ((unsigned long long)(unsigned int)tag << 32);
    asm volatile("{ .reg .b128 t; mov.b128 t, {%1, %2}; st.relaxed.gpu.global.b128 [%0], t; }"
        :: "l"((float4*)relay.data + index), "l"(low), "l"(high) : "memory");
#endif
"""

_AWAIT = """
#if defined(__CUDA_ARCH__)
    unsigned long long low, high;
    do {
        asm volatile("{ .reg .b128 t; ld.relaxed.gpu.global.b128 t, [%2]; mov.b128 {%0, %1}, t; }"
            : "=l"(low), "=l"(high) : "l"((const float4*)relay.data + index) : "memory");
    } while ((unsigned int)(high >> 32) != (unsigned int)tag);
    return wp::vec3(__uint_as_float((unsigned int)low), __uint_as_float((unsigned int)(low >> 32)),
        __uint_as_float((unsigned int)high));
#else
    return wp::vec3();
#endif
"""

# Both loads are under way before the first is looked at.
_AWAIT_BOTH = """
#if defined(__CUDA_ARCH__)
    unsigned long long low, high, next_low, next_high;
    do {
        asm volatile("{ .reg .b128 t, u; ld.relaxed.gpu.global.b128 t, [%4];"
            " ld.relaxed.gpu.global.b128 u, [%4+16]; mov.b128 {%0, %1}, t; mov.b128 {%2, %3}, u; }"
            : "=l"(low), "=l"(high), "=l"(next_low), "=l"(next_high)
            : "l"((const float4*)relay.data + index) : "memory");
    } while ((unsigned int)(high >> 32) != (unsigned int)tag
        || (unsigned int)(next_high >> 32) != (unsigned int)tag);
    wp::spatial_vector both;
    both[0] = __uint_as_float((unsigned int)low);
    both[1] = __uint_as_float((unsigned int)(low >> 32));
    both[2] = __uint_as_float((unsigned int)high);
    both[3] = __uint_as_float((unsigned int)next_low);
    both[4] = __uint_as_float((unsigned int)(next_low >> 32));
    both[5] = __uint_as_float((unsigned int)next_high);
    return both;
#else
    return wp::spatial_vector();
#endif
"""

# Warp's own load of four floats is four loads: it does not know that they are aligned.
_READ_FOUR = """
#if defined(__CUDA_ARCH__)
    const float4 found = ((const float4*)values.data)[index];
    return wp::vec4(found.x, found.y, found.z, found.w);
#else
    return values.data[index];
#endif
"""

_BITS_TO_FLOAT = """
#if defined(__CUDA_ARCH__)
    return __int_as_float(bits);
#else
    return 0.0f;
#endif
"""
_FLOAT_TO_BITS = """
#if defined(__CUDA_ARCH__)
    return __float_as_int(value);
#else
    return 0;
#endif
"""

_LANE_SUM = """
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int offset = 16; offset > 0; offset /= 2) {
        if (offset < lanes) {
            value[0] += __shfl_xor_sync(0xffffffffu, value[0], offset);
            value[1] += __shfl_xor_sync(0xffffffffu, value[1], offset);
            value[2] += __shfl_xor_sync(0xffffffffu, value[2], offset);
        }
    }
#endif
    return value;
"""

# Newton's step makes the length as exact as a rounded square root at a third of its latency.
_INVERSE_LENGTH = """
#if defined(__CUDA_ARCH__)
    return rsqrtf(fmaxf(squared, 1.0e-12f));
#else
    return 0.0f;
#endif
"""
_REFINED_LENGTH = """
#if defined(__CUDA_ARCH__)
    const float length = squared * inverse;
    return fmaf(0.5f * inverse, fmaf(-length, length, squared), length);
#else
    return 0.0f;
#endif
"""


@wp.func_native(snippet=_BARRIER)
def block_barrier():
    """Wait for all threads of the block."""


@wp.func_native(snippet=_SHARED)
def shared(slot: int, value: wp.vec4, is_write: bool) -> wp.vec4:
    """Write a slot of the block's shared memory, or read it."""


@wp.func
def shared_read(slot: int):
    """Read a vector from the block's shared memory."""
    value = shared(slot, wp.vec4(0.0, 0.0, 0.0, 0.0), False)
    return wp.vec3(value[0], value[1], value[2])


@wp.func
def shared_write(slot: int, value: wp.vec3):
    """Write a vector to the block's shared memory."""
    shared(slot, wp.vec4(value[0], value[1], value[2], 0.0), True)


@wp.func_native(snippet=_LARGE_READ)
def large_read(slot: int) -> wp.vec3:
    """Read a vector from the block's dynamic shared memory."""


@wp.func_native(snippet=_LARGE_WRITE)
def large_write(slot: int, value: wp.vec3):
    """Write a vector to the block's dynamic shared memory."""


@wp.func_native(snippet=_PUBLISH)
def publish(relay: wp.array[wp.vec4], index: int, value: wp.vec3, tag: int):
    """Let other blocks see a value, under a tag that was never used for this index before."""


@wp.func_native(snippet=_AWAIT)
def wait_for(relay: wp.array[wp.vec4], index: int, tag: int) -> wp.vec3:
    """Wait until a value is there under a tag; all blocks of the launch must be resident."""


@wp.func_native(snippet=_AWAIT_BOTH)
def wait_for_both(relay: wp.array[wp.vec4], index: int, tag: int) -> wp.spatial_vector:
    """Wait for two values that lie side by side; see `wait_for`."""


@wp.func_native(snippet=_READ_FOUR)
def read_four(values: wp.array[wp.vec4], index: int) -> wp.vec4:
    """Read four floats at once from an array that begins at a multiple of 16 bytes."""


@wp.func_native(snippet=_BITS_TO_FLOAT)
def bits_to_float(bits: int) -> float:
    """Return a float of the same bits, to be stored only."""


@wp.func_native(snippet=_FLOAT_TO_BITS)
def float_to_bits(value: float) -> int:
    """Return the bits that `bits_to_float` was given."""


@wp.func_native(snippet=_LANE_SUM)
def lane_sum(value: wp.vec3, lanes: int) -> wp.vec3:
    """Sum over 1, 2, 4, 8, 16 or 32 neighbouring threads; all threads of a warp must call it."""


@wp.func_native(snippet=_INVERSE_LENGTH)
def inverse_length(squared: float) -> float:
    """Return one over the length of a vector, whose squared length is given."""


@wp.func_native(snippet=_REFINED_LENGTH)
def refined_length(squared: float, inverse: float) -> float:
    """Return a vector's length from its square and a first guess of its inverse."""
