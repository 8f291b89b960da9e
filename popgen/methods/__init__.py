"""Methods that generate populations, a package each."""
