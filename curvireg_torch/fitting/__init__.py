"""Solvers: poses and crops of photographs in, poses that fit them out; tensors only."""
