"""What several classical methods use: limits, completion, cameras from factors, and two kinds of descent."""
