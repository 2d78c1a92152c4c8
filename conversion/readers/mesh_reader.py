"""Triangles of mesh files and primitives, cleaned; OBJ files are parsed here, with their materials where asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy

from conversion.model import FaceMaterials, Material, ObjectError
from conversion.readers.base import MAX_COORDINATE, ObjectFolder
from conversion.readers.materials import read_mtl, read_png

MESH_SUFFIXES = (".obj", ".stl", ".ply")
TEXTURE_SIZE = 512  # pixels; larger pictures are made smaller


@dataclass(frozen=True, kw_only=True)
class Mesh:
    vertices: np.ndarray  # [n, 3] float64
    faces: np.ndarray  # [m, 3] int64
    materials: FaceMaterials | None = None


class MeshReader:
    """Mesh files of one object folder, each read once."""

    def __init__(self, folder: ObjectFolder):
        self.folder = folder
        self._meshes: dict[str, Mesh | None] = {}
        self._pictures: dict[str, bytes | None] = {}

    def mesh(self, file: str, urdf: str) -> Mesh | None:
        """Triangles of a mesh file that `urdf` names, None where there is no such file. Raises ObjectError."""
        if file in self._meshes:
            return self._meshes[file]
        path = self.folder.path(file, urdf)
        if not path.is_file():
            out = None
        elif path.suffix.lower() == ".obj":
            out = self._read_obj(file, path)
        elif path.suffix.lower() in MESH_SUFFIXES:
            try:
                mesh = trimesh.load_mesh(path)
                out = Mesh(vertices=np.asarray(mesh.vertices, np.float64), faces=np.asarray(mesh.faces, np.int64))
            except Exception as e:  # trimesh raises whatever its parsing runs into
                raise self.folder.error(f"not a readable mesh ({type(e).__name__}: {e}); repair it", file) from None
        else:
            raise self.folder.error(f"mesh format {path.suffix!r} is not read; use .obj, .stl or .ply", urdf)
        if out is not None and not len(out.faces):
            raise self.folder.error("mesh is empty, it has no faces; restore it or remove it from the URDF", file)
        self._meshes[file] = out
        return out

    def _read_obj(self, file: str, path: Path) -> Mesh:
        """Vertices, faces and, where asked for, materials; polygons become fans.

        trimesh's reader wants materials and merges what it likes.
        """
        vertices: list[list[float]] = []
        faces: list[list[int]] = []
        points: list[list[float]] = [[0.0, 0.0]]  # of texture; a corner without has the first
        corners: list[list[int]] = []  # index into points
        libraries: list[str] = []
        used, materials = 0, {"": 0}
        material: list[int] = []
        textures = self.folder.config.textures
        wanted = ("v", "f", "vt", "usemtl", "mtllib") if textures else ("v", "f")
        for number, line in enumerate(path.read_text(errors="replace").replace("\\\n", " ").splitlines(), 1):
            words = line.split()
            if not words or words[0] not in wanted:
                continue
            try:
                if words[0] == "v":
                    x, y, z = map(float, words[1:4])
                    vertices.append([x, y, z])
                elif words[0] == "f":
                    corner = [int(w.split("/", 1)[0]) for w in words[1:]]
                    corner = [i - 1 if i > 0 else len(vertices) + i for i in corner]
                    fan = [(0, k, k + 1) for k in range(1, len(corner) - 1)]
                    faces.extend([corner[i] for i in triangle] for triangle in fan)
                    if textures:
                        texture = [int((w + "//").split("/")[1] or 0) for w in words[1:]]
                        texture = [i if i >= 0 else len(points) + i for i in texture]
                        corners.extend([texture[i] for i in triangle] for triangle in fan)
                        material.extend([used] * len(fan))
                elif words[0] == "vt":
                    u, v = (*map(float, words[1:3]), 0.0)[:2]
                    points.append([u, v])
                elif words[0] == "usemtl":
                    used = materials.setdefault(line.split(None, 1)[1].strip() if words[1:] else "", len(materials))
                else:
                    libraries.append(" ".join(words[1:]))
            except ValueError:
                raise self.folder.error(f"line {number} {line[:40]!r} is no OBJ line; restore the mesh", file) from None
        v, f = np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
        if len(f) and not (f.min() >= 0 and f.max() < len(v)):
            raise self.folder.error(f"a face names a vertex beyond the {len(v)} there are; restore the mesh", file)
        if len(materials) == 1:
            return Mesh(vertices=v, faces=f)
        index, uv = np.array(corners, np.int64).reshape(-1, 3), np.array(points)
        index[(index < 0) | (index >= len(uv)) | ~np.isfinite(uv).all(axis=1).take(index, mode="clip")] = 0
        found = self._materials(file, libraries, list(materials))
        # Faces are there once per side, one of them often blank; the first copy will stay.
        blank = np.array([m is None or m.png is None for m in found])
        of_faces = FaceMaterials(materials=found, index=np.array(material, np.int64), uv=uv[index])
        order = np.argsort(blank[of_faces.index], kind="stable")
        return Mesh(vertices=v, faces=f[order], materials=of_faces.subset(order))

    def _materials(self, file: str, libraries: list[str], names: list[str]) -> tuple[Material | None, ...]:
        """By name, from the MTL files that an OBJ file names; None (noted) where that fails. The first is unnamed."""
        found = {}
        for library in libraries:
            if (text := self.folder.text(_beside(file, library))) is None:
                self.folder.note(f"material library {library!r} not readable inside the folder, plain colours")
                continue
            for name, (rgba, image) in read_mtl(text).items():
                if image is not None and (png := self._picture(_beside(_beside(file, library), image))) is not None:
                    found[name] = Material(rgba=(1.0, 1.0, 1.0, rgba[3]), png=png)
                else:
                    found[name] = Material(rgba=rgba, png=None)
        for name in names[1:]:
            if libraries and found and name not in found:
                self.folder.note(f"material {name!r} is in no library, plain colour")
        return tuple(found.get(name) for name in names)

    def _picture(self, file: str) -> bytes | None:
        if file not in self._pictures:
            try:
                self._pictures[file] = read_png(self.folder.path(file, file), TEXTURE_SIZE)
            except (ObjectError, ValueError) as e:
                self._pictures[file] = None
                self.folder.note(f"texture {file!r}: {e}, plain colour")
        return self._pictures[file]


def _beside(file: str, name: str) -> str:
    """The file that `file` calls `name`."""
    return os.path.normpath((Path(file).parent / name).as_posix())


def primitive(folder: ObjectFolder, urdf: str, link: str, geometry: yourdfpy.Geometry) -> Mesh:
    """Triangles of a box, cylinder or sphere of the URDF. Raises ObjectError."""
    if geometry.box is not None:
        build, size = trimesh.creation.box, np.asarray(geometry.box.size, np.float64)
    elif geometry.cylinder is not None:
        build, size = _cylinder, np.array([geometry.cylinder.radius, geometry.cylinder.length])
    elif geometry.sphere is not None:
        build, size = _sphere, np.array([geometry.sphere.radius])
    else:
        raise folder.error(f"link {link!r} has an empty geometry; give it a mesh", urdf)
    if size.shape not in ((1,), (2,), (3,)) or not ((size > 0) & (size < MAX_COORDINATE)).all():
        raise folder.error(f"link {link!r} has a primitive of size {size}; expected positive numbers", urdf)
    mesh = build(size)
    return Mesh(vertices=np.asarray(mesh.vertices, np.float64), faces=np.asarray(mesh.faces, np.int64))


def _cylinder(size: np.ndarray) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(size[0], size[1], sections=24)


def _sphere(size: np.ndarray) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(2, size[0])


def clean(vertices: np.ndarray, faces: np.ndarray, merge: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal vertices, drop faces without area and copies of a face in either winding.

    Most meshes of the dataset hold every triangle twice, once per side.
    """
    return cleaned(vertices, faces, merge)[:2]


def cleaned(vertices: np.ndarray, faces: np.ndarray, merge: float = 1e-5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same, and which faces are left: index [k] into those given."""
    kept = np.arange(len(faces))
    if not len(faces):
        return vertices[:0], faces, kept
    _, index, inverse = np.unique(np.round(vertices / merge), axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[index], inverse.ravel()[faces]
    corners = np.sort(faces, axis=1)
    kept = kept[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])]
    if not len(kept):
        return vertices[:0], faces[:0], kept
    kept = kept[np.sort(np.unique(corners[kept], axis=0, return_index=True)[1])]
    a, b, c = vertices[faces[kept]].transpose(1, 0, 2)
    kept = kept[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12]
    used, inverse = np.unique(faces[kept], return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3), kept
