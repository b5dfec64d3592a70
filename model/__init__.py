"""The float side: network, geometry, readers, metrics, baselines, training."""
