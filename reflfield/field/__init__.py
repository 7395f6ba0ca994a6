"""The fitted reflectance field: model, evaluation, file."""
