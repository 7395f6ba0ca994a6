"""What accuracy costs in time: the model of costs, sweeps of options, presets."""
