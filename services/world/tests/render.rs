//! Images of known boxes and spheres against what geometry says they must be.
#![expect(clippy::expect_used, reason = "a test that cannot be set up fails")]

use glam::{DVec3, Vec2, Vec3};
use shared_types::frames::{Intrinsics, Pose, look_at};
use world::color::linear_from_srgb;
use world::mesh::{Material, Mesh, Placement, RawMesh, UpAxis};
use world::render::{DepthNoise, RenderOptions, RgbdImage, Threads, render};
use world::texture::Texture;
use world::{Scene, SceneConfig};

/// An axis-aligned box.
#[derive(Clone, Copy)]
struct Block {
    low: DVec3,
    high: DVec3,
}

impl Block {
    /// Entry distance of a ray, in units of its direction.
    fn entry(&self, origin: DVec3, direction: DVec3) -> Option<f64> {
        let (a, b) = ((self.low - origin) / direction, (self.high - origin) / direction);
        let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
        (enter <= leave && leave > 0.0).then_some(enter)
    }
}

const UNIT: Block = Block { low: DVec3::new(-0.5, -0.5, 0.0), high: DVec3::new(0.5, 0.5, 1.0) };

/// Blocks as a mesh, all faces with `material`; on each face u runs right and v down, seen from outside.
fn blocks(blocks: &[Block], material: Material, color: Vec3) -> RawMesh {
    let mut raw = RawMesh { materials: vec![material], ..RawMesh::default() };
    let (mut uvs, mut colors) = (Vec::new(), Vec::new());
    for block in blocks {
        let (low, high) = (block.low.as_vec3(), block.high.as_vec3());
        let center = (low + high) / 2.0;
        let half = (high - low) / 2.0;
        for outward in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z] {
            let up = if outward.z.abs() > 0.5 { Vec3::Y } else { Vec3::Z };
            // Seen from outside with `up` upwards, right is up x outward.
            let right = up.cross(outward);
            let base = raw.positions.len() as u32;
            for (u, v) in [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)] {
                raw.positions.push(center + half * (outward + right * (2.0 * u - 1.0) + up * (1.0 - 2.0 * v)));
            }
            let uv = |i: usize| [Vec2::new(0.0, 0.0), Vec2::new(0.0, 1.0), Vec2::new(1.0, 1.0), Vec2::new(1.0, 0.0)][i];
            for corners in [[0, 1, 2], [0, 2, 3]] {
                raw.triangles.push(corners.map(|i| base + i as u32));
                uvs.push(corners.map(uv));
                colors.push([color; 3]);
                raw.triangle_materials.push(0);
            }
        }
    }
    raw.uvs = Some(uvs);
    raw.colors = Some(colors);
    raw
}

fn scene(raw: RawMesh, size_m: f64, config: SceneConfig) -> Scene {
    let mesh =
        Mesh::from_raw("test".as_ref(), raw, UpAxis::Z, &Placement { size_m, ..Placement::default() }).expect("valid");
    Scene::with_mesh(mesh, &config, &Threads::new(1)).expect("valid")
}

/// A cube of 1 m with one colour, in ambient light only.
fn plain_cube() -> Scene {
    let color = Vec3::splat(0.8);
    scene(
        blocks(&[UNIT], Material::CornerColors, color),
        1.0,
        SceneConfig { sun: 0.0, ambient: 0.8, sky_srgb: [0; 3], ..SceneConfig::default() },
    )
}

fn camera() -> Intrinsics {
    Intrinsics::from_hfov(640, 480, 1.204)
}

/// Direction of the ray through a pixel's centre in the world, with z = 1 in the camera.
fn ray(pose: &Pose, camera: &Intrinsics, column: usize, row: usize) -> DVec3 {
    pose.rotation * camera.backproject(Intrinsics::pixel_center(column as u32, row as u32), 1.0)
}

fn oblique_poses() -> Vec<Pose> {
    let at = |x, y, z| look_at(DVec3::new(x, y, z), DVec3::new(0.03, -0.05, 0.4));
    vec![at(0.013, -3.0, 0.5), at(1.9, -1.1, 0.9), at(-1.2, 1.7, 2.3), at(0.4, 0.2, 3.1)]
}

#[test]
fn depth_and_mask_of_a_cube_are_those_of_geometry() {
    let (scene, camera) = (plain_cube(), camera());
    for pose in oblique_poses() {
        let image = render(&scene, &pose, &camera, &RenderOptions::default(), &Threads::new(1));
        let (mut compared, mut edge) = (0, 0);
        for (i, depth) in image.depth_m.iter().enumerate() {
            let direction = ray(&pose, &camera, i % 640, i / 640);
            let cube = UNIT.entry(pose.position_m, direction);
            let ground = (direction.z < -1e-9).then(|| -pose.position_m.z / direction.z);
            let hits_cube = cube.is_some_and(|c| ground.is_none_or(|g| c <= g));
            if hits_cube != (image.object[i] == 1) {
                edge += 1;
                continue;
            }
            let expected = if hits_cube { cube } else { ground.filter(|g| *g <= 19.1) };
            match expected {
                Some(z) => {
                    assert!((z - f64::from(*depth)).abs() < 1e-3 * (z / 5.0).max(1.0), "pixel {i}: {depth} for {z}")
                }
                None => assert!(*depth == 0.0, "pixel {i} has no surface in range, but depth {depth}"),
            }
            compared += usize::from(hits_cube);
        }
        assert!(compared > 10_000, "{compared}");
        assert!(edge <= 3, "{edge} pixels disagree about the outline");
    }
}

#[test]
fn backprojected_pixels_lie_on_the_cube() {
    let (scene, camera) = (plain_cube(), camera());
    for pose in oblique_poses() {
        let image = render(&scene, &pose, &camera, &RenderOptions::default(), &Threads::new(1));
        for (i, depth) in image.depth_m.iter().enumerate().filter(|(i, _)| image.object[*i] == 1) {
            let pixel = Intrinsics::pixel_center((i % 640) as u32, (i / 640) as u32);
            let point = pose.transform_point(camera.backproject(pixel, f64::from(*depth)));
            let outside = (UNIT.low - point).max(point - UNIT.high);
            assert!(outside.max_element().abs() < 1e-3, "{point} is not on the surface");
        }
    }
}

/// Share of a pixel that is covered by the bright object in front of a black sky.
fn share(image: &RgbdImage, column: usize, row: usize, full: f32) -> f64 {
    f64::from(linear_from_srgb(image.rgb[3 * (row * image.width + column)]) / full)
}

#[test]
fn corners_of_a_cube_appear_within_a_tenth_of_a_pixel() {
    let (scene, camera) = (plain_cube(), camera());
    for (x, z) in [(0.0, 0.3), (0.013, 0.307), (-0.021, 0.322), (0.0087, 0.29)] {
        // Level and north: the outline of the near face is a rectangle, its upper part in front of the sky.
        let eye = DVec3::new(x, -3.0, z);
        let pose = look_at(eye, eye + DVec3::Y);
        let options = RenderOptions { samples_per_edge: 8, ..RenderOptions::default() };
        let image = render(&scene, &pose, &camera, &options, &Threads::new(1));
        let project = |p: DVec3| camera.project(pose.inverse().transform_point(p)).expect("in front");
        let (left_top, right_top) = (project(DVec3::new(-0.5, -0.5, 1.0)), project(DVec3::new(0.5, -0.5, 1.0)));

        let row = left_top.y as usize + 20;
        let middle = (left_top.x + right_top.x) as usize / 2;
        let full = linear_from_srgb(image.rgb[3 * (row * 640 + middle)]);
        let covered: f64 = (0..middle).map(|column| share(&image, column, row, full)).sum();
        let left = middle as f64 - covered;
        let right = middle as f64 + (middle..640).map(|column| share(&image, column, row, full)).sum::<f64>();
        let top = row as f64 - (0..row).map(|r| share(&image, middle, r, full)).sum::<f64>();
        assert!((left - left_top.x).abs() < 0.1, "left edge at {left}, expected {}", left_top.x);
        assert!((right - right_top.x).abs() < 0.1, "right edge at {right}, expected {}", right_top.x);
        assert!((top - left_top.y).abs() < 0.1, "upper edge at {top}, expected {}", left_top.y);
    }
}

#[test]
fn colours_are_where_they_belong() {
    // Red upper left, green upper right, blue lower left, white lower right on each face.
    let texture = Texture::new(2, 2, &[255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255]).expect("four texels");
    let config = SceneConfig { sun: 0.0, ambient: 0.9, ..SceneConfig::default() };
    let scene = scene(blocks(&[UNIT], Material::Texture(texture), Vec3::ONE), 1.0, config);
    let camera = camera();
    for eye in [DVec3::new(0.0, -3.0, 0.5), DVec3::new(3.0, 0.0, 0.5), DVec3::new(0.0, 0.0, 3.5)] {
        let pose = look_at(eye, DVec3::new(0.0, 0.0, 0.5));
        let image = render(&scene, &pose, &camera, &RenderOptions::default(), &Threads::new(1));
        // Straight down, `look_at` has north at the top of the image, as the texture on the top face.
        let at = |dx: i32, dy: i32| {
            let i = ((240 + dy * 46) * 640 + 320 + dx * 46) as usize;
            [image.rgb[3 * i], image.rgb[3 * i + 1], image.rgb[3 * i + 2]].map(|c| c > 120)
        };
        assert_eq!(at(-1, -1), [true, false, false], "upper left is red, from {eye}");
        assert_eq!(at(1, -1), [false, true, false], "upper right is green, from {eye}");
        assert_eq!(at(-1, 1), [false, false, true], "lower left is blue, from {eye}");
        assert_eq!(at(1, 1), [true, true, true], "lower right is white, from {eye}");
    }
}

#[test]
fn shadows_fall_where_the_sun_is_hidden() {
    // A tall block in the west, a low one east of it; the sun in the west at 40 degrees.
    let tall = Block { low: DVec3::new(-1.0, -0.5, 0.0), high: DVec3::new(-0.5, 0.5, 1.0) };
    let low = Block { low: DVec3::new(-0.3, -0.5, 0.0), high: DVec3::new(1.0, 0.5, 0.3) };
    let config = |sun| SceneConfig {
        sun,
        ambient: 0.3,
        sun_azimuth_deg: 270.0,
        sun_elevation_deg: 40.0,
        ..SceneConfig::default()
    };
    let make = |sun| scene(blocks(&[tall, low], Material::CornerColors, Vec3::splat(0.6)), 2.0, config(sun));
    let (dark, bright) = (make(0.0), make(0.6));
    let toward_sun = bright.toward_sun().as_dvec3();
    assert!((toward_sun - DVec3::new(-40.0_f64.to_radians().cos(), 0.0, 40.0_f64.to_radians().sin())).length() < 1e-6);
    let (camera, mut counts) = (camera(), [[0; 2]; 2]);
    for eye in [DVec3::new(0.3, -0.2, 4.0), DVec3::new(2.5, -2.5, 2.0)] {
        let pose = look_at(eye, DVec3::new(0.3, 0.0, 0.2));
        let options = RenderOptions { samples_per_edge: 1, ..RenderOptions::default() };
        let (dark, bright) = (
            render(&dark, &pose, &camera, &options, &Threads::new(1)),
            render(&bright, &pose, &camera, &options, &Threads::new(1)),
        );
        for i in (0..640 * 480).filter(|i| bright.depth_m[*i] > 0.0 && bright.depth_m[*i] < 8.0) {
            let point = eye + ray(&pose, &camera, i % 640, i / 640) * f64::from(bright.depth_m[i]);
            // Lifted off its own surface, and asked at four places around: near a shadow's edge, or at a contact, either is right.
            let hidden = |offset: DVec3| [tall, low].iter().any(|b| b.entry(point + offset, toward_sun).is_some());
            let off = 0.012;
            let around =
                [(off, off), (-off, off), (off, -off), (-off, -off)].map(|(x, y)| hidden(DVec3::new(x, y, 0.004)));
            let on_edge = |b: &Block| {
                let near = |p: f64, low: f64, high: f64| usize::from((p - low).abs() < 0.03 || (p - high).abs() < 0.03);
                let inside = (b.low - 0.03).cmple(point).all() && (b.high + 0.03).cmpge(point).all();
                inside
                    && near(point.x, b.low.x, b.high.x)
                        + near(point.y, b.low.y, b.high.y)
                        + near(point.z, b.low.z, b.high.z)
                        >= 2
            };
            if on_edge(&tall) || on_edge(&low) {
                continue;
            }
            if around.iter().any(|h| *h != around[0]) {
                continue;
            }
            let lit = bright.rgb[3 * i] > dark.rgb[3 * i];
            let same = bright.rgb[3 * i] == dark.rgb[3 * i];
            assert!(
                if around[0] { same } else { lit },
                "at {point} hidden {} but {} and {}",
                around[0],
                dark.rgb[3 * i],
                bright.rgb[3 * i]
            );
            counts[usize::from(bright.object[i])][usize::from(lit)] += 1;
        }
    }
    assert!(
        counts.iter().flatten().all(|n| *n > 2000),
        "ground and object, in shadow and in the sun, were all seen: {counts:?}"
    );
}

#[test]
fn images_do_not_depend_on_the_number_of_threads() {
    let config = SceneConfig { seed: 4, ..SceneConfig::default() };
    let noise = Some(DepthNoise { sigma_at_1m_m: 0.002, seed: 9, stamp_ns: 123 });
    let options = RenderOptions { noise, ..RenderOptions::default() };
    let pose = look_at(DVec3::new(1.8, -1.4, 1.3), DVec3::new(0.0, 0.0, 0.4));
    let camera = Intrinsics::from_hfov(322, 243, 1.204);
    let image = |count: usize| {
        let threads = Threads::new(count);
        let scene = Scene::new(&config, &threads).expect("a rock");
        render(&scene, &pose, &camera, &options, &threads)
    };
    let one = image(1);
    assert!(one.object.iter().filter(|o| **o == 1).count() > 5000);
    assert!(one == image(2) && one == image(3), "the same to the last bit");
}

#[test]
fn the_sensor_has_its_range_its_noise_and_its_unit() {
    let (scene, camera) = (plain_cube(), camera());
    let pose = look_at(DVec3::new(0.0, -3.0, 0.5), DVec3::new(0.0, 0.0, 0.5));
    let image = |noise, stamp_ns| {
        let noise = Some(DepthNoise { sigma_at_1m_m: noise, seed: 1, stamp_ns });
        render(&scene, &pose, &camera, &RenderOptions { noise, ..RenderOptions::default() }, &Threads::new(1))
    };
    let exact = image(0.0, 1);
    let face: Vec<usize> = (0..640 * 480).filter(|i| exact.object[*i] == 1).collect();
    assert!(face.iter().all(|i| (exact.depth_m[*i] - 2.5).abs() < 1e-4));
    assert_eq!(exact.depth_u16(0.0005)[face[0]], 5000);
    assert!(exact.depth_m.iter().all(|d| *d == 0.0 || (0.2..=19.1).contains(d)));
    assert!(exact.depth_m.contains(&0.0), "the sky has no depth");

    let noisy = image(0.002, 1);
    let errors: Vec<f64> = face.iter().map(|i| f64::from(noisy.depth_m[*i] - exact.depth_m[*i])).collect();
    let sigma = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    assert!((sigma - 0.002 * 6.25).abs() < 0.0005, "{sigma}");
    assert_eq!(noisy.depth_m, image(0.002, 1).depth_m, "the same stamp has the same noise");
    assert_ne!(noisy.depth_m, image(0.002, 2).depth_m);
    assert_eq!(noisy.rgb, exact.rgb);
    let near = render(
        &scene,
        &pose,
        &camera,
        &RenderOptions { depth_min_m: 2.6, ..RenderOptions::default() },
        &Threads::new(1),
    );
    assert!(face.iter().all(|i| near.depth_m[*i] == 0.0), "too near for the sensor");
}

#[test]
fn depth_alone_is_the_depth_of_the_full_image() {
    let (scene, camera) = (plain_cube(), camera());
    let pose = oblique_poses()[1];
    let full = render(&scene, &pose, &camera, &RenderOptions::default(), &Threads::new(1));
    let depth =
        render(&scene, &pose, &camera, &RenderOptions { color: false, ..RenderOptions::default() }, &Threads::new(1));
    assert_eq!((full.depth_m, full.object), (depth.depth_m, depth.object));
    assert!(depth.rgb.iter().all(|c| *c == 0));
}

#[test]
fn a_curved_surface_has_no_holes() {
    let scene = Scene::new(&SceneConfig { seed: 2, ..SceneConfig::default() }, &Threads::new(2)).expect("a rock");
    let pose = look_at(DVec3::new(2.0, 1.0, 1.1), DVec3::new(0.0, 0.0, 0.4));
    let camera = camera();
    let image = render(&scene, &pose, &camera, &RenderOptions::default(), &Threads::new(2));
    // Against the library's single rays, which share nothing with the packets but the hierarchy.
    let (mut hits, mut different) = (0, 0);
    for i in (0..640 * 480).step_by(7) {
        let direction = ray(&pose, &camera, i % 640, i / 640);
        let hit = scene.index().first_hit(pose.position_m.as_vec3(), direction.as_vec3());
        let ground = if direction.z < 0.0 { -pose.position_m.z / direction.z } else { f64::INFINITY };
        let object = hit.filter(|(_, t)| f64::from(*t) <= ground);
        match object {
            Some((_, t)) if image.object[i] == 1 => {
                hits += 1;
                different += usize::from((t - image.depth_m[i]).abs() > 1e-3);
            }
            None if image.object[i] == 0 => {}
            _ => different += 1,
        }
    }
    assert!(hits > 3000, "{hits}");
    assert!(different <= 2, "{different} of {hits} rays differ");
}

#[test]
fn a_camera_close_to_large_triangles_sees_them_whole() {
    // Triangles that reach behind the camera: the eye stands 5 cm in front of a face of 1 m.
    let (scene, camera) = (plain_cube(), camera());
    let eye = DVec3::new(0.1, -0.55, 0.5);
    let pose = look_at(eye, eye + DVec3::new(1.0, 0.3, 0.0));
    let options = RenderOptions { depth_min_m: 0.0, ..RenderOptions::default() };
    let image = render(&scene, &pose, &camera, &options, &Threads::new(1));
    for i in 0..640 * 480 {
        let direction = ray(&pose, &camera, i % 640, i / 640);
        let Some(entry) = UNIT.entry(eye, direction) else { continue };
        if entry < 0.8 && eye.z + direction.z * entry > 0.01 {
            assert!((f64::from(image.depth_m[i]) - entry).abs() < 1e-3, "pixel {i}: {} for {entry}", image.depth_m[i]);
        }
    }
}

#[test]
fn finer_sampling_changes_little() {
    // Textures are filtered over the pixel's footprint: four samples must come close to sixty-four.
    let scene = Scene::new(&SceneConfig { seed: 3, ..SceneConfig::default() }, &Threads::new(2)).expect("a rock");
    let pose = look_at(DVec3::new(-1.5, -1.8, 1.0), DVec3::new(0.0, 0.0, 0.4));
    let camera = Intrinsics::from_hfov(320, 240, 1.204);
    let image = |samples_per_edge| {
        render(
            &scene,
            &pose,
            &camera,
            &RenderOptions { samples_per_edge, ..RenderOptions::default() },
            &Threads::new(2),
        )
    };
    let (one, four, many) = (image(1), image(2), image(8));
    let psnr = |a: &RgbdImage| {
        let error: f64 = a.rgb.iter().zip(&many.rgb).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum::<f64>()
            / a.rgb.len() as f64;
        10.0 * (255.0 * 255.0 / error).log10()
    };
    let (one, four) = (psnr(&one), psnr(&four));
    assert!(four > 38.0 && four > one + 5.0, "one sample {one:.1} dB, four {four:.1} dB");
}
