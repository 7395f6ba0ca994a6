"""The field in other people's formats."""
