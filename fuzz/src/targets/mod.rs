//! The targets.

mod datasets;
mod mavlink;
mod meshes;
mod missions;
mod models;
mod recordings;

use crate::Target;

/// All targets.
pub const TARGETS: &[Target] = &[
    Target { name: "mavlink", run: mavlink::px4_link, seeds: mavlink::telemetry_seeds, mutations: 5000 },
    Target { name: "mavlink-clients", run: mavlink::simulator, seeds: mavlink::client_seeds, mutations: 5000 },
    Target { name: "mesh-obj", run: meshes::obj, seeds: meshes::obj_seeds, mutations: 20000 },
    Target { name: "mesh-ply", run: meshes::ply, seeds: meshes::ply_seeds, mutations: 20000 },
    Target { name: "mesh-stl", run: meshes::stl, seeds: meshes::stl_seeds, mutations: 20000 },
    Target { name: "mesh-gltf", run: meshes::gltf, seeds: meshes::gltf_seeds, mutations: 20000 },
    Target { name: "model-ply", run: models::ply, seeds: models::ply_seeds, mutations: 20000 },
    Target { name: "model-splat", run: models::splat, seeds: models::splat_seeds, mutations: 20000 },
    Target { name: "model-spz", run: models::spz, seeds: models::spz_seeds, mutations: 20000 },
    Target { name: "model-glb", run: models::glb, seeds: models::glb_seeds, mutations: 20000 },
    Target { name: "model-checkpoint", run: models::checkpoint, seeds: models::checkpoint_seeds, mutations: 20000 },
    Target { name: "trainer-checkpoint", run: models::trainer, seeds: models::trainer_seeds, mutations: 15000 },
    Target {
        name: "reconstruct-checkpoint",
        run: models::reconstruct,
        seeds: models::reconstruct_seeds,
        mutations: 15000,
    },
    Target {
        name: "colmap-binary",
        run: datasets::colmap_binary,
        seeds: datasets::colmap_binary_seeds,
        mutations: 5000,
    },
    Target { name: "colmap-text", run: datasets::colmap_text, seeds: datasets::colmap_text_seeds, mutations: 5000 },
    Target { name: "nerfstudio", run: datasets::nerfstudio, seeds: datasets::nerfstudio_seeds, mutations: 5000 },
    Target { name: "journal", run: missions::journal, seeds: missions::journal_seeds, mutations: 500 },
    Target { name: "keyframe", run: missions::keyframe, seeds: missions::keyframe_seeds, mutations: 5000 },
    Target { name: "config", run: missions::config, seeds: missions::config_seeds, mutations: 4000 },
    Target { name: "way-back", run: missions::way_back, seeds: missions::way_back_seeds, mutations: 5000 },
    Target { name: "recording", run: recordings::recording, seeds: recordings::recording_seeds, mutations: 5000 },
];
