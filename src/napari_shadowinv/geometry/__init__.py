"""Plane geometry of power diagrams; knows no physics."""
