"""From pictures to pixels that mean something: cameras, video, segmentation, grids, tracking."""
