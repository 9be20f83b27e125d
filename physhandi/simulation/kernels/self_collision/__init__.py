"""Collisions of object nodes with each other: who may collide, how, and the adjoint."""
