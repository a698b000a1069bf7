"""Liquids in moving vessels: shapes, walls, ground truth."""
