"""The simulated dome: objects, materials, cameras, lights, effects, exact truth."""
