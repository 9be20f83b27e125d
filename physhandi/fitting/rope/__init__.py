"""Stage 2 for a rope whose grips are known: how it bends, as a discrete elastic rod.

Bending stiffness, damping of bending, drag and the curvature at rest are found by a balance of
moments along the observed rope, without a simulation (`moments`), then by steps on rollouts
(`fit`). Springs only keep its length (`bending`). docs/notes/rope.md tells what was measured.
"""
