"""Masks of sky, people and vehicles by any semantic segmenter that somebody has as ONNX.

``classes`` says which of the segmenter's classes count as which kind, ``model`` asks the segmenter about one image, and
``write`` goes through the images of a log.
"""
