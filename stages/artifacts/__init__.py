"""Run folders: manifests, data files, checkpoints, locks, and the one atomic writer."""
