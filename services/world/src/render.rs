//! RGB-D images of a scene by packets of rays.
//!
//! The rays of a tile of 8 x 8 pixels, all samples of all pixels, start at one point and lie in one narrow beam. The beam is
//! sent through the hierarchy once and collects the triangles it meets; every ray is then tested against those, four rays at
//! a time. A ray through pixel coordinates has a direction linear in them, so a triangle's three edge planes through the eye
//! (Plücker's test) cost three multiply-adds a ray, and only pixels under the triangle's outline are tested.
//!
//! Each pixel has one ray through its centre, for depth and for the object mask, and N stratified rays for colour, averaged
//! in linear light. Textures are filtered over the footprint of a sample. No value depends on the number of threads.

use glam::{Mat3, Vec2, Vec3, Vec4};
use rayon::prelude::*;

use crate::bvh::Beam;
use crate::color::srgb_from_linear_rgb;
use crate::random::{hash_pair, normal_from_hash};
use crate::scene::Scene;
use shared_types::frames::{Intrinsics, Pose};

/// Edge of a tile, pixels.
const TILE: usize = 8;
/// Triangles nearer than this to the camera's plane are tested on the whole tile instead of under their outline.
const NEAR_M: f32 = 0.02;

/// How many cores a frame may take.
pub struct Threads {
    pool: Option<rayon::ThreadPool>,
}

impl Threads {
    /// One thread is the caller's own; more are a pool of that size. Where the system gives no threads, the caller's own
    /// does the work.
    #[must_use]
    pub fn new(count: usize) -> Self {
        let pool = if count > 1 { rayon::ThreadPoolBuilder::new().num_threads(count).build().ok() } else { None };
        Self { pool }
    }

    /// Runs work that uses rayon with this number of threads.
    pub fn install<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.pool {
            Some(pool) => pool.install(work),
            None => single_thread(work),
        }
    }
}

/// Runs work that uses rayon on a thread of its own, and not on rayon's global pool, which takes every core.
fn single_thread<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
        Ok(pool) => pool.install(work),
        // No thread to be had: slower neighbours are better than no scene.
        Err(_no_thread) => work(),
    }
}

/// Noise of the depth sensor: normal, independent per pixel, its standard deviation growing with the square of the range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthNoise {
    /// Standard deviation at 1 m, metres; 0 for none.
    pub sigma_at_1m_m: f32,
    /// Seed of the mission.
    pub seed: u64,
    /// Stamp of the image: every image has its own noise, the same one each time it is rendered.
    pub stamp_ns: u64,
}

/// What to render.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// Colour samples along each edge of a pixel: 1, 2 (4 samples, the default) or 4 (16 samples); at most 8.
    pub samples_per_edge: u32,
    /// Whether colour is wanted; without it the colour is black, and the image costs a third.
    pub color: bool,
    /// Nearest depth the sensor measures, metres.
    pub depth_min_m: f32,
    /// Farthest depth the sensor measures, metres.
    pub depth_max_m: f32,
    /// The sensor's noise.
    pub noise: Option<DepthNoise>,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { samples_per_edge: 2, color: true, depth_min_m: 0.2, depth_max_m: 19.1, noise: None }
    }
}

/// A rendered image, row by row from the upper left.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbdImage {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// sRGB, three bytes a pixel.
    pub rgb: Vec<u8>,
    /// Centre z of the ray through the pixel's centre, metres; 0 where nothing was measured.
    pub depth_m: Vec<f32>,
    /// 1 where the ray through the pixel's centre hits the object, else 0.
    pub object: Vec<u8>,
}

impl RgbdImage {
    /// Depth in units of `depth_unit_m`, rounded; 0 where nothing was measured. What does not fit is 0, too.
    #[must_use]
    pub fn depth_u16(&self, depth_unit_m: f32) -> Vec<u16> {
        let code = |depth: f32| (depth / depth_unit_m + 0.5).floor();
        self.depth_m.iter().map(|d| if code(*d) <= f32::from(u16::MAX) { code(*d) as u16 } else { 0 }).collect()
    }
}

/// Renders the scene as the camera at `world_from_camera` sees it.
#[must_use]
pub fn render(
    scene: &Scene,
    world_from_camera: &Pose,
    intrinsics: &Intrinsics,
    options: &RenderOptions,
    threads: &Threads,
) -> RgbdImage {
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let mut image = RgbdImage {
        width,
        height,
        rgb: vec![0; width * height * 3],
        depth_m: vec![0.0; width * height],
        object: vec![0; width * height],
    };
    if width == 0 || height == 0 {
        return image;
    }
    let frame = Frame::new(scene, world_from_camera, intrinsics, options);
    type Band<'b> = ((&'b mut [u8], &'b mut [f32]), &'b mut [u8]);
    let band = |(row, ((rgb, depth), object)): (usize, Band<'_>)| frame.render_band(row * TILE, rgb, depth, object);
    match &threads.pool {
        None => {
            let depth = image.depth_m.chunks_mut(TILE * width);
            let bands = image.rgb.chunks_mut(TILE * width * 3).zip(depth).zip(image.object.chunks_mut(TILE * width));
            bands.enumerate().for_each(band);
        }
        Some(pool) => pool.install(|| {
            let depth = image.depth_m.par_chunks_mut(TILE * width);
            let bands =
                image.rgb.par_chunks_mut(TILE * width * 3).zip(depth).zip(image.object.par_chunks_mut(TILE * width));
            bands.enumerate().for_each(band);
        }),
    }
    image
}

/// Positions of the stratified samples in a pixel: an n x n grid, each row and column of it slanted, so that no two samples
/// share an x or a y. Their mean is the pixel's centre.
fn sample_offsets(per_edge: u32) -> Vec<Vec2> {
    let n = per_edge.clamp(1, 8);
    let at = |cell: u32, slant: u32| (cell as f32 + (slant as f32 + 0.5) / n as f32) / n as f32;
    (0..n).flat_map(|j| (0..n).map(move |i| Vec2::new(at(i, j), at(j, n - 1 - i)))).collect()
}

/// What all tiles of a frame share.
struct Frame<'a> {
    scene: &'a Scene,
    options: &'a RenderOptions,
    width: usize,
    eye: Vec3,
    world_from_camera: Mat3,
    /// Vertices in the camera frame, metres.
    vertices: Vec<Vec3>,
    focal: Vec2,
    center: Vec2,
    /// All samples of a pixel in normalised image coordinates, four to a group: the centre first, then those for colour.
    groups: Vec<(Vec4, Vec4)>,
    /// Number and place of the colour samples among them.
    colors: std::ops::Range<usize>,
    /// Width of a colour sample at 1 m, metres.
    sample_width: f32,
}

/// Buffers of a band, reused from tile to tile.
#[derive(Default)]
struct Tile {
    stack: Vec<u32>,
    candidates: Vec<u32>,
    depths: Vec<Vec4>,
    triangles: Vec<[u32; 4]>,
}

/// A triangle as seen from the eye, for rays (x, y, 1).
struct Edges {
    /// Normals of the planes through the eye and each edge, positive inside.
    planes: [Vec3; 3],
    normal: Vec3,
    /// `normal` times any corner: depth is this over `normal` times the ray.
    offset: f32,
}

impl<'a> Frame<'a> {
    fn new(scene: &'a Scene, world_from_camera: &Pose, intrinsics: &Intrinsics, options: &'a RenderOptions) -> Self {
        let eye = world_from_camera.position_m.as_vec3();
        let rotation = Mat3::from_quat(world_from_camera.rotation.as_quat().normalize());
        let camera_from_world = rotation.transpose();
        let vertices = scene.mesh().positions.iter().map(|p| camera_from_world * (*p - eye)).collect();
        let focal = Vec2::new(intrinsics.fx as f32, intrinsics.fy as f32);
        let mut offsets = vec![Vec2::splat(0.5)];
        let colors = match options.samples_per_edge {
            _ if !options.color => 0..0,
            0 | 1 => 0..1,
            per_edge => {
                offsets.extend(sample_offsets(per_edge));
                1..offsets.len()
            }
        };
        let groups = offsets
            .chunks(4)
            .map(|chunk| {
                // A last group that is not full repeats the pixel's centre.
                let lane = |k: usize| chunk.get(k).copied().unwrap_or(Vec2::splat(0.5)) / focal;
                let lanes = [lane(0), lane(1), lane(2), lane(3)];
                (Vec4::from_array(lanes.map(|l| l.x)), Vec4::from_array(lanes.map(|l| l.y)))
            })
            .collect();
        Self {
            scene,
            options,
            width: intrinsics.width as usize,
            eye,
            world_from_camera: rotation,
            vertices,
            focal,
            center: Vec2::new(intrinsics.cx as f32, intrinsics.cy as f32),
            groups,
            sample_width: 1.0 / (focal.x.min(focal.y) * (colors.len().max(1) as f32).sqrt()),
            colors,
        }
    }

    /// Normalised image coordinates of the upper left corner of a pixel.
    fn corner(&self, x: usize, y: usize) -> Vec2 {
        (Vec2::new(x as f32, y as f32) - self.center) / self.focal
    }

    fn render_band(&self, top: usize, rgb: &mut [u8], depth: &mut [f32], object: &mut [u8]) {
        let rows = depth.len() / self.width;
        let mut tile = Tile::default();
        for left in (0..self.width).step_by(TILE) {
            let columns = TILE.min(self.width - left);
            let hit = self.trace_tile(&mut tile, (left, top), (columns, rows));
            for row in 0..rows {
                for column in 0..columns {
                    let cell = row * TILE + column;
                    let at = row * self.width + left + column;
                    let seen = hit.then(|| {
                        (&tile.depths[cell * self.groups.len()..], &tile.triangles[cell * self.groups.len()..])
                    });
                    let pixel = self.shade_pixel((left + column, top + row), seen);
                    rgb[3 * at..3 * at + 3].copy_from_slice(&srgb_from_linear_rgb(pixel.color));
                    depth[at] = self.measured(pixel.depth_m, (top + row) * self.width + left + column);
                    object[at] = u8::from(pixel.object);
                }
            }
        }
    }

    /// Finds the nearest triangle of every ray of a tile. False if the beam meets none.
    fn trace_tile(&self, tile: &mut Tile, (left, top): (usize, usize), (columns, rows): (usize, usize)) -> bool {
        let (low, high) = (self.corner(left, top), self.corner(left + columns, top + rows));
        let normals = [
            Vec3::new(1.0, 0.0, -low.x),
            Vec3::new(-1.0, 0.0, high.x),
            Vec3::new(0.0, 1.0, -low.y),
            Vec3::new(0.0, -1.0, high.y),
            Vec3::Z,
        ];
        let beam = Beam::new(self.eye, normals.map(|n| self.world_from_camera * n));
        tile.candidates.clear();
        self.scene.index().collect(&beam, &mut tile.stack, &mut tile.candidates);
        if tile.candidates.is_empty() {
            return false;
        }
        let cells = TILE * TILE * self.groups.len();
        tile.depths.clear();
        tile.depths.resize(cells, Vec4::INFINITY);
        tile.triangles.clear();
        tile.triangles.resize(cells, [0; 4]);
        for i in 0..tile.candidates.len() {
            let triangle = tile.candidates[i];
            let Some((edges, columns, rows)) = self.outline(triangle, (left, top), (columns, rows)) else { continue };
            for row in rows {
                for column in columns.clone() {
                    let ray = self.corner(left + column, top + row);
                    let cell = (row * TILE + column) * self.groups.len();
                    self.test(&edges, triangle, ray, &mut tile.depths[cell..], &mut tile.triangles[cell..]);
                }
            }
        }
        true
    }

    /// A triangle's edges, and the columns and rows of the tile under its outline. `None` if it lies outside.
    fn outline(
        &self,
        triangle: u32,
        (left, top): (usize, usize),
        (columns, rows): (usize, usize),
    ) -> Option<(Edges, std::ops::Range<usize>, std::ops::Range<usize>)> {
        let indices = self.scene.mesh().triangles[triangle as usize];
        let [a, b, c] = indices.map(|i| self.vertices[i as usize]);
        let (mut column_range, mut row_range) = (0..columns, 0..rows);
        if a.z.min(b.z).min(c.z) > NEAR_M {
            let project =
                |p: Vec3| Vec2::new(p.x, p.y) / p.z * self.focal + self.center - Vec2::new(left as f32, top as f32);
            let (a, b, c) = (project(a), project(b), project(c));
            // A hundredth of a pixel of slack covers rounding.
            let low = a.min(b).min(c) - 0.01;
            let high = a.max(b).max(c) + 0.01;
            if high.x < 0.0 || high.y < 0.0 || low.x >= columns as f32 || low.y >= rows as f32 {
                return None;
            }
            // Casts from float saturate, so a huge outline is cut off at the tile.
            column_range = low.x.max(0.0) as usize..(high.x as usize + 1).min(columns);
            row_range = low.y.max(0.0) as usize..(high.y as usize + 1).min(rows);
        } else if a.z.max(b.z).max(c.z) <= 0.0 {
            return None;
        }
        let normal = (b - a).cross(c - a);
        let offset = normal.dot(a);
        // Neighbours share an edge in opposite directions. Computed from the lower vertex number to the higher, both get the
        // same plane to the last bit, and no ray slips between them.
        let plane = |i: usize, j: usize| {
            let (p, q) = (self.vertices[indices[i] as usize], self.vertices[indices[j] as usize]);
            if indices[i] < indices[j] { p.cross(q - p) } else { -q.cross(p - q) }
        };
        let side = if offset < 0.0 { -1.0 } else { 1.0 };
        let planes = [plane(0, 1) * side, plane(1, 2) * side, plane(2, 0) * side];
        Some((Edges { planes, normal, offset }, column_range, row_range))
    }

    /// Tests the rays of one pixel, whose upper left corner has the coordinates `ray`.
    #[inline]
    fn test(&self, edges: &Edges, triangle: u32, ray: Vec2, depths: &mut [Vec4], triangles: &mut [[u32; 4]]) {
        let base = edges.planes.map(|p| p.x * ray.x + p.y * ray.y + p.z);
        let facing = edges.normal.x * ray.x + edges.normal.y * ray.y + edges.normal.z;
        for ((x, y), (depth, owner)) in self.groups.iter().zip(depths.iter_mut().zip(triangles)) {
            let value = |k: usize| *x * edges.planes[k].x + *y * edges.planes[k].y + base[k];
            let inside = value(0).min(value(1)).min(value(2)).cmpge(Vec4::ZERO);
            if !inside.any() {
                continue;
            }
            let z = edges.offset / (*x * edges.normal.x + *y * edges.normal.y + facing);
            let nearer = inside & z.cmplt(*depth) & z.cmpgt(Vec4::ZERO);
            if nearer.any() {
                *depth = Vec4::select(nearer, z, *depth);
                let bits = nearer.bitmask();
                for (k, id) in owner.iter_mut().enumerate() {
                    if bits >> k & 1 == 1 {
                        *id = triangle;
                    }
                }
            }
        }
    }

    fn shade_pixel(&self, (x, y): (usize, usize), seen: Option<(&[Vec4], &[[u32; 4]])>) -> Pixel {
        let corner = self.corner(x, y);
        let down = self.world_from_camera.row(2);
        let ground_depth = |ray: Vec3| {
            let fall = -down.dot(ray);
            if fall > 1e-6 && self.eye.z > 0.0 { self.eye.z / fall } else { f32::INFINITY }
        };
        let center = (corner + 0.5 / self.focal).extend(1.0);
        let center_ground = ground_depth(center);
        // The footprint on the ground is an ellipse: its mean radius decides the mip level, for all samples of the pixel.
        let length = center.length();
        let grazing = (-down.dot(center) / length).max(1e-3);
        let lod = crate::ground::Ground::lod(center_ground.min(1e4) * length * self.sample_width / grazing.sqrt());

        let mut sum = Vec3::ZERO;
        for k in self.colors.clone() {
            let (dx, dy) = self.groups[k / 4];
            let ray = Vec3::new(corner.x + dx[k % 4], corner.y + dy[k % 4], 1.0);
            let ground = ground_depth(ray);
            let object = seen.map(|(depths, triangles)| (depths[k / 4][k % 4], triangles[k / 4][k % 4]));
            sum += match object {
                Some((depth, triangle)) if depth <= ground && depth < f32::INFINITY => {
                    self.shade_object(triangle as usize, ray, depth)
                }
                _ if ground < f32::INFINITY => {
                    self.scene.ground_radiance(self.eye + self.world_from_camera * (ray * ground), lod)
                }
                _ => self.scene.sky(),
            };
        }
        let center_object = seen.map_or(f32::INFINITY, |(depths, _)| depths[0].x);
        Pixel {
            color: sum / self.colors.len().max(1) as f32,
            depth_m: center_object.min(center_ground),
            object: center_object <= center_ground && center_object < f32::INFINITY,
        }
    }

    fn shade_object(&self, triangle: usize, ray: Vec3, depth: f32) -> Vec3 {
        let [a, b, c] = self.scene.mesh().triangles[triangle].map(|i| self.vertices[i as usize]);
        let point = ray * depth;
        let (ab, ac, ap) = (b - a, c - a, point - a);
        let normal = ab.cross(ac);
        let scale = 1.0 / normal.length_squared().max(1e-30);
        let (v, w) = (ap.cross(ac).dot(normal) * scale, ab.cross(ap).dot(normal) * scale);
        let cosine = normal.dot(ray);
        let facing = self.world_from_camera * (if cosine > 0.0 { -normal } else { normal });
        // Foreshortening stretches the footprint one way; the mean radius decides, as on the ground.
        let grazing = (cosine.abs() * scale.sqrt() / ray.length()).max(0.05);
        let footprint_m = depth * self.sample_width / grazing.sqrt();
        self.scene.object_radiance(triangle, (v, w), self.eye + self.world_from_camera * point, facing, footprint_m)
    }

    /// What the sensor makes of a true depth at pixel number `index`.
    fn measured(&self, depth_m: f32, index: usize) -> f32 {
        let range = self.options.depth_min_m..=self.options.depth_max_m;
        if !range.contains(&depth_m) {
            return 0.0;
        }
        let noisy = match self.options.noise {
            Some(noise) if noise.sigma_at_1m_m > 0.0 => {
                let hash = hash_pair(noise.seed ^ noise.stamp_ns.rotate_left(32), index as u64);
                depth_m + noise.sigma_at_1m_m * depth_m * depth_m * normal_from_hash(hash) as f32
            }
            _ => depth_m,
        };
        if range.contains(&noisy) { noisy } else { 0.0 }
    }
}

/// What a pixel shows.
struct Pixel {
    color: Vec3,
    depth_m: f32,
    object: bool,
}
