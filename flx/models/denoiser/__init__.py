"""The denoising networks: the paper's, and ours."""
