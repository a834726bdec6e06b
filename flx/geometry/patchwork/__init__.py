"""New textures from pieces of an old one: `synthesis` is the whole, the other modules are its steps."""
