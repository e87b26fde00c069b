"""Run folders: manifests, data files, checkpoints, locks, and the atomic writer."""
