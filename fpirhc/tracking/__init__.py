"""Tracking laws: the desired response that brings the plant back to its nominal motion."""
