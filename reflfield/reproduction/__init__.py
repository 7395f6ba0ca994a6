"""The tables and figures of the paper, made anew and shown beside the paper's."""
