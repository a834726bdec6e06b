"""Mesh files taken apart and put together: OBJ with MTL, PLY, glTF; nothing here judges or repairs."""
