"""What tests of meshes share."""

from tests._support.meshes import load as load
