//! What every source of images must do, as checks that a source's tests run against it.
//!
//! A check drives the source through a [`Bench`], which also lets whatever is behind the source work. A check that fails
//! says what was expected.

use std::collections::BTreeSet;

use shared_types::frames::Intrinsics;
use shared_types::messages::RenderPurpose;

use crate::source::{Delivery, ImageRequest, RgbdSource};

/// A source on the bench.
pub trait Bench {
    /// The source.
    fn source(&mut self) -> &mut dyn RgbdSource;
    /// Lets what is behind the source make progress (a world's process, a driver's thread).
    fn work(&mut self);
    /// An instant of which the source has an image.
    fn known_ns(&self) -> u64;
    /// An instant of which it has none and never will.
    fn unknown_ns(&self) -> u64;
    /// How far the stamp of an image may be from the wanted instant: 0 for a renderer, half a frame for a driver.
    fn stamp_tolerance_ns(&self) -> u64;
    /// The camera that the source gives for a purpose.
    fn intrinsics(&self, purpose: RenderPurpose) -> Intrinsics;
}

/// Name and outcome of each check.
pub fn check_all(bench: &mut dyn Bench) -> Vec<(&'static str, Result<(), String>)> {
    vec![
        ("an image fits its request", an_image_fits_its_request(bench)),
        ("every request is answered once", every_request_is_answered_once(bench)),
        ("a cancelled request is not answered", a_cancelled_request_is_not_answered(bench)),
        ("an unknown instant is gone", an_unknown_instant_is_gone(bench)),
        ("the same instant gives the same image", the_same_instant_gives_the_same_image(bench)),
    ]
}

const TURNS: usize = 2_000;

/// A delivery, copied.
struct Copied {
    id: u64,
    image: Option<(u64, Intrinsics, f64, bool, Vec<u8>)>,
}

fn ask(bench: &mut dyn Bench, id: u64, purpose: RenderPurpose, stamp_ns: u64) -> Result<(), String> {
    let request = ImageRequest { id, purpose, stamp_ns, intrinsics: bench.intrinsics(purpose) };
    bench.source().request(stamp_ns, &request).map_err(|error| error.to_string())
}

/// Lets the source work until `wanted` deliveries have come, then a little longer.
fn collect(bench: &mut dyn Bench, wanted: usize) -> Result<Vec<Copied>, String> {
    let now_ns = bench.known_ns();
    let mut all = Vec::new();
    let mut rest = 20;
    for _ in 0..TURNS {
        bench.work();
        let mut take = |delivery: Delivery<'_>| {
            let id = delivery.id();
            let image = match delivery {
                Delivery::Image(i) => Some((i.stamp_ns, i.intrinsics, i.depth_unit_m, i.has_color, i.items.to_vec())),
                Delivery::Gone { .. } | Delivery::Refused { .. } => None,
            };
            all.push(Copied { id, image });
        };
        bench.source().poll(now_ns, &mut take).map_err(|error| error.to_string())?;
        if all.len() >= wanted {
            rest -= 1;
        }
        if rest == 0 {
            break;
        }
    }
    Ok(all)
}

fn an_image_fits_its_request(bench: &mut dyn Bench) -> Result<(), String> {
    for (id, purpose) in [(11, RenderPurpose::Capture), (12, RenderPurpose::Stream), (13, RenderPurpose::Depth)] {
        let (stamp_ns, camera) = (bench.known_ns(), bench.intrinsics(purpose));
        ask(bench, id, purpose, stamp_ns)?;
        let all = collect(bench, 1)?;
        let [Copied { id: answered, image: Some((stamp, intrinsics, unit_m, has_color, items)) }] = all.as_slice()
        else {
            return Err(format!("expected one image for {purpose}, found {} deliveries", all.len()));
        };
        let pixels = camera.width as usize * camera.height as usize;
        let wants_color = purpose != RenderPurpose::Depth;
        let bytes = pixels * if wants_color { 5 } else { 2 };
        if *answered != id {
            return Err(format!("expected an answer to {id}, found one to {answered}"));
        }
        if stamp.abs_diff(stamp_ns) > bench.stamp_tolerance_ns() {
            return Err(format!("expected an image of {stamp_ns} ns, found one of {stamp} ns"));
        }
        if *intrinsics != camera || *has_color != wants_color || items.len() != bytes {
            return Err(format!("expected {camera:?} and {bytes} bytes, found {intrinsics:?} and {}", items.len()));
        }
        if !(unit_m.is_finite() && *unit_m > 0.0) {
            return Err(format!("expected a depth unit above 0, found {unit_m}"));
        }
        let depth = items.get(bytes - pixels * 2..).unwrap_or_default();
        if depth.iter().all(|&byte| byte == 0) {
            return Err(format!("expected some depth in an image for {purpose}, found none"));
        }
    }
    Ok(())
}

fn every_request_is_answered_once(bench: &mut dyn Bench) -> Result<(), String> {
    let stamp_ns = bench.known_ns();
    let ids = [21, 22, 23];
    for (id, purpose) in ids.into_iter().zip([RenderPurpose::Capture, RenderPurpose::Depth, RenderPurpose::Stream]) {
        ask(bench, id, purpose, stamp_ns)?;
    }
    let answered: Vec<u64> = collect(bench, ids.len())?.iter().map(|delivery| delivery.id).collect();
    let distinct: BTreeSet<u64> = answered.iter().copied().collect();
    if answered.len() == ids.len() && distinct == BTreeSet::from(ids) {
        return Ok(());
    }
    Err(format!("expected one answer to each of {ids:?}, found answers to {answered:?}"))
}

fn a_cancelled_request_is_not_answered(bench: &mut dyn Bench) -> Result<(), String> {
    let stamp_ns = bench.known_ns();
    ask(bench, 31, RenderPurpose::Depth, stamp_ns)?;
    bench.source().cancel(31);
    ask(bench, 32, RenderPurpose::Depth, stamp_ns)?;
    let answered: Vec<u64> = collect(bench, 1)?.iter().map(|delivery| delivery.id).collect();
    if answered == [32] { Ok(()) } else { Err(format!("expected an answer to 32 alone, found {answered:?}")) }
}

fn an_unknown_instant_is_gone(bench: &mut dyn Bench) -> Result<(), String> {
    let stamp_ns = bench.unknown_ns();
    ask(bench, 41, RenderPurpose::Depth, stamp_ns)?;
    match collect(bench, 1)?.as_slice() {
        [Copied { id: 41, image: None }] => Ok(()),
        other => Err(format!("expected the instant to be gone, found {} deliveries", other.len())),
    }
}

fn the_same_instant_gives_the_same_image(bench: &mut dyn Bench) -> Result<(), String> {
    let stamp_ns = bench.known_ns();
    let mut images = Vec::new();
    for id in [51, 52] {
        ask(bench, id, RenderPurpose::Capture, stamp_ns)?;
        images.extend(collect(bench, 1)?.into_iter().filter_map(|delivery| delivery.image));
    }
    match images.as_slice() {
        [first, second] if first == second => Ok(()),
        [_, _] => Err("expected the same image twice, found two that differ".to_owned()),
        other => Err(format!("expected two images, found {}", other.len())),
    }
}
