"""What the stages of a job are called, in the order in which they are done."""

HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION = (
    "hand_reconstruction",
    "observation",
    "zeroth_order",
    "first_order",
    "hand_refinement",
    "evaluation",
)
STAGES = (HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION)
"""Stages of a reconstruction."""
SIMULATION = "simulation"
"""The first stage of a simulation."""
