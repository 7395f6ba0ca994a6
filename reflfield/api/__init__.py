"""What `import reflfield` offers beside classes of the other packages: captures to results."""
