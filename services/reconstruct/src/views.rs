//! Training views within a bound of memory: prepared once while there is room, else made anew for each step.
//!
//! A prepared view takes 17 bytes a pixel, a compact image 4 to 11. Which views are kept does not change a bit of the result.

use splatting::{TrainingView, ViewError};

use crate::dataset::Image;

/// Pixels of a tile's side, and bytes of a prepared tile.
const TILE: u64 = 16;
const TILE_BYTES: u64 = TILE * TILE * 16 + 4 * 2 * TILE;

/// The images that are trained on.
pub struct Views<'a> {
    images: Vec<&'a Image>,
    kept: Vec<Option<TrainingView>>,
    bytes_left: u64,
    bytes_used: u64,
}

impl core::fmt::Debug for Views<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Views").field("images", &self.images.len()).field("bytes_used", &self.bytes_used).finish()
    }
}

impl<'a> Views<'a> {
    /// Views of these images; prepared ones take at most `bytes`.
    #[must_use]
    pub fn new(images: Vec<&'a Image>, bytes: u64) -> Self {
        let kept = images.iter().map(|_| None).collect();
        Self { images, kept, bytes_left: bytes, bytes_used: 0 }
    }

    /// Number of views.
    #[must_use]
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// The images.
    #[must_use]
    pub fn images(&self) -> &[&'a Image] {
        &self.images
    }

    /// Bytes that prepared views take.
    #[must_use]
    pub fn bytes_used(&self) -> u64 {
        self.bytes_used
    }

    /// Gives a view to `work`.
    ///
    /// # Errors
    /// Where the renderer refuses the image; names it.
    ///
    /// # Panics
    /// Where `index` is not below [`Views::len`], as a slice does.
    pub fn with<R>(&mut self, index: usize, work: impl FnOnce(&TrainingView) -> R) -> Result<R, (String, ViewError)> {
        if let Some(view) = &self.kept[index] {
            return Ok(work(view));
        }
        let image = self.images[index];
        let view = image.training_view().map_err(|error| (image.name.clone(), error))?;
        let result = work(&view);
        let bytes = view_bytes(image);
        if bytes <= self.bytes_left {
            self.bytes_left -= bytes;
            self.bytes_used += bytes;
            self.kept[index] = Some(view);
        }
        Ok(result)
    }
}

fn view_bytes(image: &Image) -> u64 {
    u64::from(image.camera.width).div_ceil(TILE) * u64::from(image.camera.height).div_ceil(TILE) * TILE_BYTES
}
