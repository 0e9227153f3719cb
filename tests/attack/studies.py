"""A study that is killed again and again: nothing that was finished is lost, and nothing is there twice."""

from __future__ import annotations
