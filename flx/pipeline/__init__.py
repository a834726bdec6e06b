"""Side effects: disk, devices, clocks."""
