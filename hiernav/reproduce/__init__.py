"""The paper's tables and figures as a queue of cells that can be stopped, and the small result files it leaves."""
