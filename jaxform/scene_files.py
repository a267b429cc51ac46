"""Scene and study files, fields in mesh files, and files that are written whole or not at all."""

from jaxform.core.disk import atomic_path, expand_path, read_text, write_all, write_error
from jaxform.io import schema
from jaxform.io.files import SceneDocument, StudyDocument, build, read_scene, read_study
from jaxform.io.geometry import nodal_field, transfer_values
from jaxform.io.scene_rewriting import file_key, replacement_path
from jaxform.mesh.meshes import Mesh

__all__ = [
    "Mesh",
    "SceneDocument",
    "StudyDocument",
    "atomic_path",
    "build",
    "expand_path",
    "file_key",
    "nodal_field",
    "read_scene",
    "read_study",
    "read_text",
    "replacement_path",
    "schema",
    "transfer_values",
    "write_all",
    "write_error",
]
