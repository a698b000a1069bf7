"""When things run: the stages of an experiment, their artifacts, sweeps and reports. Hydra is imported only here."""
