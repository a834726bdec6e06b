"""The field-latent VAE: the paper's architecture, and ours."""
