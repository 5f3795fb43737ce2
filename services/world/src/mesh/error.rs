//! What can be wrong with a mesh. Each message names the file, what was found, what was expected, and the way out.

use std::path::PathBuf;

use glam::Vec3;

/// A mesh that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    /// The file, or one it needs, cannot be opened or read.
    #[error("mesh {}: cannot be read: {source}; check the path and its permissions", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The file has no bytes.
    #[error("mesh {}: the file is empty (0 bytes), a mesh was expected; export it again", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The extension names no format that is read.
    #[error(
        "mesh {}: the extension {found:?} is no mesh format read here; use .obj, .ply, .stl, .gltf or .glb, or the word \"rock\" for the procedural rock",
        path.display()
    )]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// The extension found.
        found: String,
    },
    /// The content is not what the format demands.
    #[error("mesh {}: {found}; expected {expected}; export the mesh again, or convert it to another format", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What was found, and where.
        found: String,
        /// What the format demands.
        expected: &'static str,
    },
    /// No triangle with an area is left.
    #[error(
        "mesh {}: has {vertices} vertices and no triangle with an area; a surface was expected, not a point cloud or lines: export faces, or reconstruct a surface first",
        path.display()
    )]
    NoTriangles {
        /// The file.
        path: PathBuf,
        /// Vertices in the file.
        vertices: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("mesh {}: vertex {vertex} is {value}; finite coordinates were expected; repair the mesh (remove non-finite vertices)", path.display())]
    NonFinite {
        /// The file.
        path: PathBuf,
        /// Index of the vertex, from 0.
        vertex: usize,
        /// Its coordinates.
        value: Vec3,
    },
    /// A triangle names a vertex that does not exist.
    #[error(
        "mesh {}: triangle {triangle} refers to vertex {index}, but there are {vertices} vertices (0 to {}); repair or export the mesh again",
        path.display(),
        vertices.saturating_sub(1)
    )]
    IndexOutOfRange {
        /// The file.
        path: PathBuf,
        /// Index of the triangle, from 0.
        triangle: usize,
        /// The vertex named.
        index: u64,
        /// Vertices there are.
        vertices: usize,
    },
    /// A wish that cannot be fulfilled.
    #[error("object {key} = {value}: expected {expected}")]
    BadPlacement {
        /// The key of the configuration.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
}
