//! Appearance: the model against the truth on held-out views.

use shared_types::frames::{Intrinsics, Pose};
use splatting::metrics::{masked_ssim, psnr};
use splatting::{Camera, Engine, Gaussians, RenderSettings, Rendered};
use world::truth::HeldOutView;

use super::Effort;
use super::truth::{TrueImage, Truth, cores};

/// A held-out view with its truth.
#[derive(Debug, Clone)]
pub struct TrueView {
    view: HeldOutView,
    truth: TrueImage,
}

/// Means over the held-out views. A figure without a view to measure it on is absent.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Quality {
    /// Object mask at R, dB.
    pub object_db: Option<f64>,
    /// Object mask at 0.8 R, dB.
    pub object_near_db: Option<f64>,
    /// Whole image at R, dB.
    pub frame_db: Option<f64>,
    /// Object mask at R.
    pub ssim_object: Option<f64>,
    /// One constant colour, the object's mean over all views at R, dB.
    pub null_db: Option<f64>,
}

/// Renders the truth of the held-out views.
///
/// # Errors
/// When the candidates leave no room for so many views.
pub fn held_out(truth: &Truth, effort: Effort) -> anyhow::Result<Vec<TrueView>> {
    let views = truth.held_out(effort.views)?;
    let one = |view: &HeldOutView| TrueView {
        view: *view,
        truth: truth.image(&view.world_from_camera, effort.width, effort.height),
    };
    in_parallel(&views, |chunk| Ok(chunk.iter().map(one).collect()))
}

/// Measures a model.
///
/// # Errors
/// When the renderer's threads cannot be started.
pub fn appearance(truth: &Truth, gaussians: &Gaussians, views: &[TrueView], effort: Effort) -> anyhow::Result<Quality> {
    let intrinsics = truth.intrinsics(effort.width, effort.height);
    let null = mean_color(views);
    let scores = in_parallel(views, |chunk| {
        let mut engine = Engine::new(1)?;
        let mut rendered = Rendered::default();
        let mut scores = Vec::with_capacity(chunk.len());
        for view in chunk {
            let camera = camera_of(&view.view.world_from_camera, &intrinsics);
            engine.render(gaussians, &camera, &RenderSettings::default(), &mut rendered);
            scores.push(Score::of(view, &rendered.color, null, (effort.width as usize, effort.height as usize)));
        }
        Ok(scores)
    })?;
    let far = || scores.iter().filter(|score| !score.near);
    Ok(Quality {
        object_db: mean(far().filter_map(|score| score.object_db)),
        object_near_db: mean(scores.iter().filter(|score| score.near).filter_map(|score| score.object_db)),
        frame_db: mean(far().filter_map(|score| score.frame_db)),
        ssim_object: mean(far().filter_map(|score| score.ssim)),
        null_db: mean(far().filter_map(|score| score.null_db)),
    })
}

/// A camera of the splatting library.
#[must_use]
pub fn camera_of(world_from_camera: &Pose, intrinsics: &Intrinsics) -> Camera {
    reconstruct::dataset::camera_of(world_from_camera, intrinsics, 1)
}

/// Figures of one view.
#[derive(Debug, Clone, Copy)]
struct Score {
    near: bool,
    object_db: Option<f64>,
    frame_db: Option<f64>,
    ssim: Option<f64>,
    null_db: Option<f64>,
}

impl Score {
    fn of(view: &TrueView, color: &[[f32; 3]], null: [f32; 3], (width, height): (usize, usize)) -> Self {
        let TrueImage { color: truth, object } = &view.truth;
        let constant = vec![null; truth.len()];
        Self {
            near: view.view.near,
            object_db: finite(psnr(color, truth, Some(object))),
            frame_db: finite(psnr(color, truth, None)),
            ssim: masked_ssim(color, truth, object, width, height),
            null_db: finite(psnr(&constant, truth, Some(object))),
        }
    }
}

fn finite(value: Option<f64>) -> Option<f64> {
    value.filter(|value| value.is_finite())
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0_u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

/// Mean colour of the object over all views at R.
fn mean_color(views: &[TrueView]) -> [f32; 3] {
    let (mut sum, mut count) = ([0.0_f64; 3], 0.0_f64);
    for view in views.iter().filter(|view| !view.view.near) {
        for (color, _) in view.truth.color.iter().zip(&view.truth.object).filter(|(_, object)| **object) {
            for (total, value) in sum.iter_mut().zip(color) {
                *total += f64::from(*value);
            }
            count += 1.0;
        }
    }
    #[expect(clippy::cast_possible_truncation, reason = "colours are f32")]
    sum.map(|total| if count > 0.0 { (total / count) as f32 } else { 0.5 })
}

/// Gives each core a part of the items and puts the results together in the items' order.
fn in_parallel<T: Sync, R: Send>(
    items: &[T],
    work: impl Fn(&[T]) -> Result<Vec<R>, splatting::EngineError> + Sync,
) -> anyhow::Result<Vec<R>> {
    let share = items.len().div_ceil(cores()).max(1);
    let parts = std::thread::scope(|scope| {
        let handles: Vec<_> = items.chunks(share).map(|chunk| scope.spawn(|| work(chunk))).collect();
        handles.into_iter().map(std::thread::ScopedJoinHandle::join).collect::<Vec<_>>()
    });
    let mut all = Vec::with_capacity(items.len());
    for part in parts {
        let part =
            part.map_err(|_panic| anyhow::anyhow!("a worker of the evaluation panicked; see the message above"))?;
        all.extend(part?);
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_come_back_in_order() {
        let items: Vec<u32> = (0..103).collect();
        assert_eq!(in_parallel(&items, |chunk| Ok(chunk.to_vec())).expect("done"), items);
        assert!(in_parallel(&Vec::<u32>::new(), |chunk| Ok(chunk.to_vec())).expect("done").is_empty());
    }

    #[test]
    fn the_mean_of_nothing_is_absent() {
        assert_eq!(mean(std::iter::empty()), None);
        assert_eq!(mean([1.0, 3.0].into_iter()), Some(2.0));
    }
}
