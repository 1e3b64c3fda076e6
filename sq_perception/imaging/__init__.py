"""Cameras, rendering and views: from bodies to depth images and back."""
