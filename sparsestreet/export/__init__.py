"""A scene for others: Gaussians for viewers, the cameras of its log, camera paths and videos."""
