"""What is wrong with a capture, before anything is made of it."""
