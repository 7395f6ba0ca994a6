"""The web page that shows and relights a field."""
