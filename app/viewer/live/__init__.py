"""Live simulation: from a slider to a kernel and back.

The way of a value goes straight down: `physics.panel` → `physics.history` (one step a gesture) →
`client.LiveRollouts` → `client.SimulationClient` → `wire` ⇒ process ⇒ `worker` → the library's
fitted object → simulator → engine → kernel. Arguments flow down, and frames come back with the
number of their request. The latest request wins: the worker replaces what a session asked for
before, and `LiveRollouts` refuses frames of another number than its newest request's.
"""
