"""Many candidates at once: one substep, a whole frame, their losses, and the loads of substeps."""
