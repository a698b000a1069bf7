"""Only what a scene needs: from an error and a frame budget to the cheapest twin that meets them, by measured data."""
