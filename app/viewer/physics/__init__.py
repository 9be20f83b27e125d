"""Control of the simulation: parameters, history, presets and the physics panel."""
