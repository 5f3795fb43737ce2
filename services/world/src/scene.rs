//! The world of a mission: one object on the lunar ground under the sun. Built once, read by every frame and by the
//! evaluation tools; the same configuration gives the same scene, for any number of threads.

use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};

use crate::albedo::{Breccia, SurfaceLattice};
use crate::bvh::MeshIndex;
use crate::color::linear_rgb_from_srgb;
use crate::ground::Ground;
use crate::mesh::{Material, Mesh, MeshError, Placement, UpAxis};
use crate::render::Threads;
use crate::rock;
use crate::shadow::ShadowMap;

/// What stands in the world, and in which light.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneConfig {
    /// `"rock"` for the procedural rock, else the path of a mesh.
    pub object: String,
    /// Largest extent of the object, metres.
    pub size_m: f64,
    /// Turn of the object about the vertical, degrees.
    pub yaw_deg: f64,
    /// Which axis of the mesh points up.
    pub up: UpAxis,
    /// Seed of the rock, the procedural albedo and the ground.
    pub seed: u64,
    /// Where the sun stands, clockwise from north, degrees.
    pub sun_azimuth_deg: f64,
    /// Height of the sun above the horizon, degrees.
    pub sun_elevation_deg: f64,
    /// Light of the sun on a surface that faces it, as a share of full scale.
    pub sun: f64,
    /// Light from everywhere else on an upward surface, as a share of full scale.
    pub ambient: f64,
    /// Colour of the sky, sRGB.
    pub sky_srgb: [u8; 3],
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            object: "rock".to_owned(),
            size_m: 1.5,
            yaw_deg: 0.0,
            up: UpAxis::Auto,
            seed: 1,
            sun_azimuth_deg: 215.0,
            sun_elevation_deg: 48.0,
            sun: 0.95,
            ambient: 0.34,
            sky_srgb: [18, 19, 24],
        }
    }
}

/// A scene that cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The object.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// A setting of the light.
    #[error("{key} = {value}: expected {expected}")]
    BadLight {
        /// The key of the configuration.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
}

/// Everything a ray can meet.
pub struct Scene {
    mesh: Mesh,
    index: MeshIndex,
    lattice: SurfaceLattice,
    ground: Ground,
    shadows: ShadowMap,
    light: Light,
    /// Texels of the triangle's texture per metre of its surface; 0 without a texture.
    texels_per_m: Vec<f32>,
}

/// The light of a scene, linear.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Light {
    pub(crate) toward_sun: Vec3,
    pub(crate) sun: f32,
    pub(crate) ambient: f32,
    pub(crate) sky: Vec3,
}

/// Light thrown back by the ground onto downward surfaces, as a share of the ambient light.
const BOUNCE: f32 = 0.45;

impl Scene {
    /// Builds a scene from its configuration.
    ///
    /// # Errors
    /// [`SceneError`] if the mesh cannot be used or a setting is out of range.
    pub fn new(config: &SceneConfig, threads: &Threads) -> Result<Self, SceneError> {
        let placement = Placement { size_m: config.size_m, yaw_deg: config.yaw_deg, up: config.up };
        let mesh = if config.object == "rock" {
            Mesh::from_raw(Path::new("rock"), rock::rock(config.seed), UpAxis::Z, &placement)?
        } else {
            Mesh::load(&PathBuf::from(&config.object), &placement)?
        };
        Self::with_mesh(mesh, config, threads)
    }

    /// Builds a scene around a mesh that is already placed; `object`, `yaw_deg` and `up` of the configuration are not used.
    ///
    /// # Errors
    /// [`SceneError::BadLight`] if a setting is out of range.
    pub fn with_mesh(mesh: Mesh, config: &SceneConfig, threads: &Threads) -> Result<Self, SceneError> {
        let light = Light::new(config)?;
        let has_lattice = |t: usize| matches!(material(&mesh, t), Material::Procedural);
        let breccia = Breccia::new(config.seed, config.size_m as f32);
        let (lattice, ground) = threads.install(|| {
            let lattice = SurfaceLattice::sample_from(&mesh, config.size_m as f32, has_lattice, |p| breccia.albedo(p));
            (lattice, Ground::new(config.seed, light.toward_sun))
        });
        let texels_per_m = (0..mesh.triangles.len()).map(|t| texel_density(&mesh, t)).collect();
        let index = MeshIndex::new(&mesh);
        let shadows = ShadowMap::new(&mesh, light.toward_sun);
        Ok(Self { mesh, index, lattice, ground, shadows, light, texels_per_m })
    }

    /// The object, in world coordinates.
    #[must_use]
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The object's hierarchy, for rays and distances.
    #[must_use]
    pub fn index(&self) -> &MeshIndex {
        &self.index
    }

    /// Unit direction towards the sun.
    #[must_use]
    pub fn toward_sun(&self) -> Vec3 {
        self.light.toward_sun
    }

    pub(crate) fn sky(&self) -> Vec3 {
        self.light.sky
    }

    /// Linear radiance of the ground at a point, filtered over 2^`lod` texels.
    #[inline]
    pub(crate) fn ground_radiance(&self, point: Vec3, lod: f32) -> Vec3 {
        let light = &self.light;
        let sun = light.sun * light.toward_sun.z * self.shadows.lit_ground(point);
        self.ground.albedo(Vec2::new(point.x, point.y), lod) * (sun + light.ambient)
    }

    /// Linear radiance of the object at barycentric (`v`, `w`) of a triangle. `facing` is its geometric normal turned
    /// towards the viewer; `footprint_m` the width of the sample on the surface.
    #[inline]
    pub(crate) fn object_radiance(
        &self,
        triangle: usize,
        (v, w): (f32, f32),
        point: Vec3,
        facing: Vec3,
        footprint_m: f32,
    ) -> Vec3 {
        let blend = |[a, b, c]: [Vec3; 3]| a * (1.0 - v - w) + b * v + c * w;
        let albedo = match material(&self.mesh, triangle) {
            Material::Texture(texture) => {
                let [a, b, c] = self.mesh.uvs[triangle];
                let lod = crate::texture::log2_approx(footprint_m * self.texels_per_m[triangle]);
                texture.sample(a * (1.0 - v - w) + b * v + c * w, lod)
            }
            Material::CornerColors => self.mesh.colors.get(triangle).map_or(Vec3::splat(0.5), |colors| blend(*colors)),
            Material::Procedural => self.lattice.color(triangle, v, w),
        };
        let normal = blend(self.mesh.normals[triangle]).normalize_or(facing);
        // Surfaces have two sides: an open mesh, or one wound inwards, is lit on the side that is seen.
        let normal = if normal.dot(facing) < 0.0 { -normal } else { normal };
        let light = &self.light;
        let towards = normal.dot(light.toward_sun);
        let sun = if towards > 0.0 { light.sun * towards * self.shadows.lit_surface(point, normal) } else { 0.0 };
        let ambient = light.ambient * (0.5 * (1.0 + BOUNCE) + 0.5 * (1.0 - BOUNCE) * normal.z);
        albedo * (sun + ambient)
    }
}

impl Light {
    fn new(config: &SceneConfig) -> Result<Self, SceneError> {
        let within = |key, value: f64, low: f64, high: f64, expected| {
            if value >= low && value <= high { Ok(()) } else { Err(SceneError::BadLight { key, value, expected }) }
        };
        within("sun_elevation_deg", config.sun_elevation_deg, 5.0, 90.0, "an angle from 5 to 90 degrees")?;
        within("sun_azimuth_deg", config.sun_azimuth_deg, -360.0, 360.0, "an angle from -360 to 360 degrees")?;
        within("sun", config.sun, 0.0, 10.0, "a share of full scale from 0 to 10")?;
        within("ambient", config.ambient, 0.0, 10.0, "a share of full scale from 0 to 10")?;
        let (azimuth, elevation) = (config.sun_azimuth_deg.to_radians(), config.sun_elevation_deg.to_radians());
        let toward_sun =
            glam::DVec3::new(azimuth.sin() * elevation.cos(), azimuth.cos() * elevation.cos(), elevation.sin());
        Ok(Self {
            toward_sun: toward_sun.as_vec3(),
            sun: config.sun as f32,
            ambient: config.ambient as f32,
            sky: linear_rgb_from_srgb(config.sky_srgb),
        })
    }
}

fn material(mesh: &Mesh, triangle: usize) -> &Material {
    mesh.materials.get(usize::from(mesh.triangle_materials[triangle])).unwrap_or(&Material::Procedural)
}

fn texel_density(mesh: &Mesh, triangle: usize) -> f32 {
    let Material::Texture(texture) = material(mesh, triangle) else { return 0.0 };
    let [a, b, c] = mesh.uvs[triangle];
    let (width, height) = texture.size();
    let uv_area = 0.5 * (b - a).perp_dot(c - a).abs();
    let area = crate::mesh::area(mesh.corners(triangle));
    (uv_area * width as f32 * height as f32 / area.max(1e-12)).sqrt()
}
