"""Soft maps between triangle meshes."""
