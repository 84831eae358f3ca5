"""The paper's tables and figures as runnable experiments, and the timing of the package itself."""
