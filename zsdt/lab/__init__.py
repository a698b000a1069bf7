"""The virtual laboratory: a camera in front of a simulation that the twin does not know (DESIGN 5).

Nothing that comes from here is real, and nothing here is called so.
"""
