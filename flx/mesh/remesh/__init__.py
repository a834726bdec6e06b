"""The steps of remeshing, from random collapses to the last touch; see `flx.mesh.triangulations`."""
