"""What each stage of the pipeline reads, computes and writes."""
