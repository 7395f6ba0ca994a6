"""What every package uses: checked input, files written whole, progress, signals."""
