//! Ground truth of a sphere against closed formulas.
#![expect(clippy::expect_used, reason = "a test that cannot be set up fails")]

use glam::{DVec3, Vec3};
use shared_types::frames::{Intrinsics, Pose, look_at};
use world::bvh::MeshIndex;
use world::mesh::{Material, Mesh, Placement, RawMesh, UpAxis};
use world::render::Threads;
use world::truth::{
    CoverageMeter, HeldOutRules, SurfaceSamples, ViewLimits, compare, held_out_views, spiral_directions,
    visible_samples,
};

const RADIUS_M: f64 = 0.75;

/// A finely triangulated sphere that stands on the ground.
fn sphere() -> Mesh {
    let (rings, segments) = (90_u32, 180_u32);
    let mut positions = vec![Vec3::Z];
    for i in 1..rings {
        for j in 0..segments {
            let (theta, phi) = (
                std::f64::consts::PI * f64::from(i) / f64::from(rings),
                std::f64::consts::TAU * f64::from(j) / f64::from(segments),
            );
            positions.push(DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()).as_vec3());
        }
    }
    positions.push(Vec3::NEG_Z);
    let last = positions.len() as u32 - 1;
    let at = |i: u32, j: u32| {
        if i == 0 {
            0
        } else if i == rings {
            last
        } else {
            1 + (i - 1) * segments + j % segments
        }
    };
    let triangles: Vec<[u32; 3]> = (0..rings)
        .flat_map(|i| {
            (0..segments).flat_map(move |j| {
                [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]]
            })
        })
        .collect();
    let raw = RawMesh {
        positions,
        triangle_materials: vec![0; triangles.len()],
        triangles,
        materials: vec![Material::Procedural],
        ..RawMesh::default()
    };
    Mesh::from_raw("sphere".as_ref(), raw, UpAxis::Z, &Placement { size_m: 2.0 * RADIUS_M, ..Placement::default() })
        .expect("valid")
}

fn center() -> DVec3 {
    DVec3::new(0.0, 0.0, RADIUS_M)
}

fn pose(direction: DVec3) -> Pose {
    look_at(center() + direction.normalize_or_zero() * 2.5, center())
}

/// Share of a sphere that is seen from a distance of 2.5 m from its centre at an incidence below 80 degrees.
fn cap_share() -> f64 {
    let beta = 80.0_f64.to_radians();
    let alpha = beta - (RADIUS_M * beta.sin() / 2.5).asin();
    (1.0 - alpha.cos()) / 2.0
}

#[test]
fn samples_are_even_and_reproducible() {
    let mesh = sphere();
    let samples = SurfaceSamples::new(&mesh, 20_000, 5);
    assert_eq!(samples, SurfaceSamples::new(&mesh, 20_000, 5));
    assert_ne!(samples, SurfaceSamples::new(&mesh, 20_000, 6));
    for (p, n) in samples.points.iter().zip(&samples.normals) {
        let outward = p.as_dvec3() - center();
        assert!((outward.length() - RADIUS_M).abs() < 1e-3 && outward.normalize_or_zero().dot(n.as_dvec3()) > 0.999);
    }
    // Archimedes: equal heights have equal areas.
    for (low, high, share) in [(0.0, 0.3, 0.2), (0.3, 0.75, 0.3), (1.2, 1.5, 0.2)] {
        let inside = samples.points.iter().filter(|p| (low..high).contains(&p.z)).count() as f64 / 20_000.0;
        assert!((inside - share).abs() < 0.005, "{inside} for {share}");
    }
}

#[test]
fn one_view_of_a_sphere_covers_a_cap() {
    let mesh = sphere();
    let (index, samples) = (MeshIndex::new(&mesh), SurfaceSamples::new(&mesh, 20_000, 1));
    let limits = ViewLimits::new(Intrinsics::from_hfov(640, 480, 1.204));
    // Straight down, the rings of facets lie along the rim of the cap, and it is cut at whole facets.
    for (direction, tolerance) in
        [(DVec3::new(1.0, 0.3, 0.17), 0.004), (DVec3::new(-1.0, 2.0, 1.0), 0.004), (DVec3::Z, 0.012)]
    {
        let seen = visible_samples(&index, &samples, &pose(direction), &limits, &Threads::new(1));
        let share = seen.iter().filter(|s| **s).count() as f64 / 20_000.0;
        assert!((share - cap_share()).abs() < tolerance, "{share} for {}", cap_share());
        assert_eq!(seen, visible_samples(&index, &samples, &pose(direction), &limits, &Threads::new(2)));
    }
    let away = Pose { rotation: pose(DVec3::X).rotation, position_m: center() - DVec3::X * 2.5 };
    assert!(
        visible_samples(&index, &samples, &away, &limits, &Threads::new(1)).iter().all(|s| !s),
        "a camera that looks away"
    );
    let short = ViewLimits { depth_max_m: 1.0, ..limits };
    assert!(
        visible_samples(&index, &samples, &pose(DVec3::X), &short, &Threads::new(1)).iter().all(|s| !s),
        "out of range"
    );
}

#[test]
fn coverage_counts_baselines_and_what_is_feasible() {
    let mesh = sphere();
    let (index, samples) = (MeshIndex::new(&mesh), SurfaceSamples::new(&mesh, 20_000, 1));
    let limits = ViewLimits::new(Intrinsics::from_hfov(640, 480, 1.204));
    let threads = Threads::new(2);
    let meter = CoverageMeter::new(&index, &samples, limits, (center(), 2.5, 0.3), &threads);
    // The lowest camera sees down to its own cap's rim; what lies below is not feasible.
    let lowest_rad = ((0.3 - RADIUS_M) / 2.5).asin();
    let cap_rad = (1.0 - 2.0 * cap_share()).acos();
    let feasible = (1.0 - (lowest_rad - cap_rad).max(-std::f64::consts::FRAC_PI_2).sin()) / 2.0;
    let found = meter.feasible_once().iter().filter(|f| **f).count() as f64 / 20_000.0;
    assert!((found - feasible).abs() < 0.01, "{found} for {feasible}");
    assert!(meter.feasible_once().iter().zip(meter.feasible_twice()).all(|(once, twice)| *once || !twice));

    let east_west = meter.measure(&[pose(DVec3::X), pose(DVec3::NEG_X)], &threads);
    assert!((east_west.cov1_total - 2.0 * cap_share()).abs() < 0.006, "two caps that do not meet");
    assert!(east_west.cov2_total == 0.0 && east_west.auc == 0.0);
    assert!((east_west.cov1_feasible - 2.0 * cap_share() / found).abs() < 0.02);

    let turned = |deg: f64| pose(DVec3::new(deg.to_radians().cos(), deg.to_radians().sin(), 0.0));
    assert!(meter.measure(&[turned(0.0), turned(4.0)], &threads).cov2_total == 0.0, "4 degrees are no baseline");
    let pair = meter.measure(&[turned(0.0), turned(20.0), turned(40.0)], &threads);
    assert!(pair.cov2_total > 0.2 && pair.cov2_total < pair.cov1_total);
    assert!(pair.curve.len() == 3 && pair.curve[0] == 0.0 && pair.curve.is_sorted());
    assert!(
        (pair.curve[2] - pair.cov2_feasible).abs() < 1e-12
            && (pair.auc - pair.curve.iter().sum::<f64>() / 3.0).abs() < 1e-12
    );
    assert_eq!(pair, meter.measure(&[turned(0.0), turned(20.0), turned(40.0)], &Threads::new(1)));

    let all: Vec<Pose> = spiral_directions(200, lowest_rad.sin()).into_iter().map(pose).collect();
    let full = meter.measure(&all, &threads);
    assert!(full.cov1_feasible > 0.99 && full.cov2_feasible > 0.98 && full.cov1_feasible <= 1.0, "{full:?}");
}

#[test]
fn distances_between_shells_are_their_gap() {
    let mesh = sphere();
    let (index, samples) = (MeshIndex::new(&mesh), SurfaceSamples::new(&mesh, 5_000, 1));
    let shell = |radius: f64| -> Vec<Vec3> {
        spiral_directions(60_000, -1.0).into_iter().map(|d| (center() + d * radius).as_vec3()).collect()
    };
    let threads = Threads::new(2);
    let far = compare(&shell(RADIUS_M + 0.02), &index, &samples, &[0.01, 0.03], &threads).expect("points");
    assert!((far.accuracy_m - 0.02).abs() < 5e-4, "{far:?}");
    assert!((far.completeness_m - 0.02).abs() < 1e-3 && (far.chamfer_m - 0.02).abs() < 1e-3);
    assert!(far.f_scores[0].1 == 0.0 && far.f_scores[1].1 > 0.999);
    // Half of the surface: accurate, incomplete.
    let half: Vec<Vec3> = shell(RADIUS_M).into_iter().filter(|p| p.x > 0.0).collect();
    let half = compare(&half, &index, &samples, &[0.015], &threads).expect("points");
    assert!(half.accuracy_m < 5e-4 && half.completeness_m > 0.1);
    assert!((half.f_scores[0].1 - 2.0 / 3.0).abs() < 0.02, "precision 1, recall 1/2: {half:?}");
    assert!(compare(&[], &index, &samples, &[0.1], &threads).is_none());
    assert!(compare(&[Vec3::NAN], &index, &samples, &[0.1], &threads).is_none());
}

proptest::proptest! {
    #[test]
    fn held_out_views_keep_their_distance(height in 0.5..3.0_f64, width in 0.5..3.0_f64, radius_m in 1.5..4.0_f64, turn in 0.0..6.2_f64, candidates in 50_usize..200) {
        let corners = (DVec3::new(-width / 2.0, -0.5, 0.0), DVec3::new(width / 2.0, 0.5, height));
        let center = DVec3::new(0.0, 0.0, height / 2.0);
        let avoid: Vec<DVec3> = spiral_directions(candidates, -1.0).into_iter().map(|d| glam::DQuat::from_rotation_z(turn) * d).collect();
        let rules = HeldOutRules::default();
        let views = held_out_views(corners, radius_m, &avoid, &rules).expect("there is room");
        proptest::prop_assert_eq!(views.len(), 100);
        proptest::prop_assert_eq!(views.iter().filter(|v| v.near).count(), 50);
        for view in &views {
            let offset = view.world_from_camera.position_m - center;
            let direction = offset.normalize_or_zero();
            let expected = if view.near { 0.8 * radius_m } else { radius_m };
            proptest::prop_assert!((offset.length() - expected).abs() < 1e-9);
            proptest::prop_assert!(direction.z.asin().to_degrees() >= 5.0);
            proptest::prop_assert!(avoid.iter().all(|a| a.angle_between(direction).to_degrees() > 4.999));
            let forward = view.world_from_camera.rotation * DVec3::Z;
            proptest::prop_assert!((forward + direction).length() < 1e-6, "looks at the centre of the box");
        }
        proptest::prop_assert_eq!(&views, &held_out_views(corners, radius_m, &avoid, &rules).expect("again"));
    }
}

#[test]
fn no_room_for_held_out_views_is_said() {
    let corners = (DVec3::new(-0.5, -0.5, 0.0), DVec3::new(0.5, 0.5, 1.0));
    let error =
        held_out_views(corners, 2.0, &spiral_directions(4000, -1.0), &HeldOutRules::default()).expect_err("no room");
    assert!(error.to_string().contains("4000"));
}
