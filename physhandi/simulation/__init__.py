"""The object under the hand: a spring-mass system driven by control nodes."""
