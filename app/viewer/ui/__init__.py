"""What every part of the viewer uses: guarded callbacks, keys, and a viser server of their own."""
