"""The learned engine: thermodynamics-informed graph networks (seed, Section III.A; DESIGN 4)."""
