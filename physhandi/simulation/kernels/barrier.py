"""How the threads of a CPU wait for each other between substeps."""

import warp as wp

wp.set_module_options({"enable_backward": False})

NO_STOP = -2
"""In `meeting[1]`: no thread wants to stop."""
ABORT = -1
"""In `meeting[1]`: all threads stop at once, in the middle of a substep."""

# A thread that waits too long, because others want the processors, asks to stop at the next
# meeting; as it says so before it arrives there, all see it after it.
_MEET = """
#if !defined(__CUDA_ARCH__)
    if (threads == 1) return 0;
    int* const arrived = meeting.data;
    int* const stop = meeting.data + 1;
    const int all = (number + 1) * threads;
    if (waited > 1000) __atomic_store_n(stop, number, __ATOMIC_RELAXED);
    __atomic_add_fetch(arrived, 1, __ATOMIC_ACQ_REL);
    for (int spin = 0; __atomic_load_n(arrived, __ATOMIC_ACQUIRE) < all; ++spin) {
        if (__atomic_load_n(stop, __ATOMIC_RELAXED) == -1) return -1;
        if (spin < 2000 || give_way == 0) {
    #if defined(__x86_64__) || defined(__i386__)
            __builtin_ia32_pause();
    #elif defined(__aarch64__)
            __asm__ volatile("yield");
    #endif
        } else {
            typedef void function();
            ((function*)give_way)();
            ++waited;
        }
    }
    return __atomic_load_n(stop, __ATOMIC_RELAXED) == number ? -1 : waited;
#else
    return 0;
#endif
"""


@wp.func_native(snippet=_MEET)
def meet(
    meeting: wp.array[int], number: int, threads: int, waited: int, give_way: wp.uint64
) -> int:
    """Wait until all threads have come to a meeting; they meet in the order of its number.

    Args:
        meeting: How often threads arrived, and the meeting after which they stop.
        number: Of this meeting, counted from 0.
        threads: How many meet.
        waited: What the last meeting returned, at first 0.
        give_way: Address of a function that lets other processes have the processor, or 0.

    Returns:
        How often the processor was given away, or -1 if all threads are to stop.
    """
