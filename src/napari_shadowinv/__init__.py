"""Shadowgrams and proton radiographs to deflection potentials and line-integrated fields."""
