"""Ways to run the same substeps: graphs of launches, one launch a frame, threads, batches.

Every engine integrates the same laws; it writes them once, in the form in which it is fast:

==================  =============================  ================================================
engine              spring law                     why it has its own
==================  =============================  ================================================
`graph` (any        `kernels.springs`, derivative  One launch a law, springs first and then nodes:
device)             in `kernels.adjoint`           the reference, and the way of self-collision,
                                                   of hands that push (`kernels.hand_contact`)
                                                   and of ropes that bend (`kernels.rod`).
`cpu`               `kernels.simd`                 Eight springs at a time by the vector units,
                                                   which Warp's own CPU code does not use.
`cuda`              `kernels.cuda_frame.pull`,     A frame is one launch whose threads keep their
                    `kernels.cuda_adjoint`         springs in registers; no launch between substeps.
`side_by_side`      those of `cuda`                Tens of candidates: bodies of one launch a frame.
`batch`             `kernels.batch.substep`        Many candidates: a thread works on one node of
                                                   several, whose numbers lie side by side.
==================  =============================  ================================================

`simulation.forces` computes the law once more, in float64 and for single frames, for what is
drawn; `benchmarks.phystwin_like` is PhysTwin's, atomics included. Tests compare all of them with
one oracle.

On CUDA two kernels move a frame. `kernels.cuda_frame` keeps nodes in static shared memory and can
record a tape for gradients; `kernels.cuda_large_frame` has room for objects whose blocks do not fit
there. The first is up to 12 % faster where springs are many (docs/benchmarks/h200_kernels.json),
and alone has an adjoint, so both stay.
"""
