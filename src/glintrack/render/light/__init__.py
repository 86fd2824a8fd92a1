"""Light: sky and air, and probes of what stands around, which light every surface."""
