"""What sliders change: parameters, history, presets and the physics panel."""
