"""Exports a scene: Gaussians for viewers, camera paths and videos."""
