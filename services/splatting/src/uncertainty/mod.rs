//! How uncertain a model is about what a view would show (Eq. 1-3): the variance of depth in each pixel of the projected
//! box, from the moments that a render gives.
//!
//! [`variance`] is the formula, [`footprint`] which pixels count. Asked by [`Backend::uncertainties`] for many views; a GPU
//! adds up the pixels itself, so that no image comes back.
//!
//! [`Backend::uncertainties`]: crate::Backend::uncertainties

pub mod footprint;
pub mod variance;

pub use footprint::BoundingBox;
pub use variance::{Uncertainty, uncertainty};

use crate::camera::Camera;
use crate::engine::MomentsView;

/// How the depth variance of a pixel is taken (A1, A3, A4).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum VarianceMode {
    /// As printed: raw moments, transparent pixels (B/2)².
    Paper,
    /// Normalised by alpha, transparent pixels L²/12 of the ray's chord in the box.
    #[default]
    Normalised,
}

/// What is asked of every view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UncertaintySettings {
    /// How variance is taken.
    pub mode: VarianceMode,
    /// The box whose inside is in question.
    pub bounding_box: BoundingBox,
    /// Pixels with less alpha know nothing of depth.
    pub transparent_alpha: f64,
}

impl UncertaintySettings {
    /// What is rendered of a view: depths are relative to that of the box's centre.
    pub(crate) fn view(&self, camera: &Camera) -> MomentsView {
        MomentsView { camera: *camera, reference_m: self.bounding_box.center_depth(camera) as f32 }
    }
}
