"""The page on which a mesh and its paintings are looked at: one file for a browser or a notebook."""
