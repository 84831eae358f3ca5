"""The laboratory: what runs the experiments, and what several of them share. The questions stand one folder up."""
