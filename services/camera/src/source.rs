//! Where RGB-D images come from: the contract that every source keeps, whatever is behind it.
//!
//! A source is asked for the image of an instant and delivers it later, in place: the images are borrowed for the
//! duration of a call, so that they go from where the source has them straight into shared memory. What any source must
//! do is written as checks in [`crate::conformance`].

use shared_types::bus::BusError;
use shared_types::frames::Intrinsics;
use shared_types::messages::RenderPurpose;

/// What is asked of a source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageRequest {
    /// Names the request; never used twice.
    pub id: u64,
    /// What it is for: captures are asked for at the full size, depth without colour.
    pub purpose: RenderPurpose,
    /// Mission time of the wanted image. A source with frames of its own delivers the nearest.
    pub stamp_ns: u64,
    /// The wanted camera, size included.
    pub intrinsics: Intrinsics,
}

/// An image, borrowed from its source.
#[derive(Debug, Clone, Copy)]
pub struct Image<'a> {
    /// Id of the request.
    pub id: u64,
    /// Mission time of the image: the middle of the exposure, the driver's delay taken off.
    pub stamp_ns: u64,
    /// The camera of these pixels; the centre of pixel (0, 0) is (0.5, 0.5).
    pub intrinsics: Intrinsics,
    /// Metres per unit of depth.
    pub depth_unit_m: f64,
    /// Whether the items begin with colour.
    pub has_color: bool,
    /// `width * height * 3` bytes of sRGB if `has_color`, then `width * height` little-endian u16 of depth.
    pub items: &'a [u8],
}

/// What a source hands over.
#[derive(Debug)]
pub enum Delivery<'a> {
    /// The image.
    Image(Image<'a>),
    /// The source no longer has, or never had, that instant: another one must be chosen.
    Gone {
        /// Id of the request.
        id: u64,
    },
    /// The source will never be able to answer this.
    Refused {
        /// Id of the request.
        id: u64,
        /// Why.
        reason: String,
    },
}

impl Delivery<'_> {
    /// Id of the request that is answered.
    #[must_use]
    pub fn id(&self) -> u64 {
        match self {
            Self::Image(image) => image.id,
            Self::Gone { id } | Self::Refused { id, .. } => *id,
        }
    }
}

/// Why a source cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The bus to the source's process failed.
    #[error(transparent)]
    Bus(#[from] BusError),
}

/// Gives RGB-D images of wanted instants.
pub trait RgbdSource {
    /// Asks for an image. Every request is answered once by [`Self::poll`], however long it takes, unless cancelled; a
    /// source that is not there now answers when it is back.
    ///
    /// # Errors
    /// When the source can never answer again.
    fn request(&mut self, now_ns: u64, request: &ImageRequest) -> Result<(), SourceError>;

    /// Forgets a request; nothing is delivered for it any more.
    fn cancel(&mut self, id: u64);

    /// Hands over what is ready. Never blocks.
    ///
    /// # Errors
    /// When the source can never answer again.
    fn poll(&mut self, now_ns: u64, deliver: &mut dyn FnMut(Delivery<'_>)) -> Result<(), SourceError>;

    /// Locks exposure and white balance at their present values, or lets them go. Sources whose exposure never changes
    /// need do nothing.
    fn lock_exposure(&mut self, _locked: bool) {}
}
