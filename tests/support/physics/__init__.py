"""Bodies, hands and pictures whose motion or shape is known in closed form."""
