"""Training: run folders, checkpoints, the loop, and what each model learns from."""
