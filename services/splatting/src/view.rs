//! A keyframe as the loss wants it: tiled target colours, depth, and which pixels count for what (A31).

use std::sync::atomic::{AtomicU64, Ordering};

use thiserror::Error;

use crate::camera::Camera;
use crate::frame::{Plane, TILE};

/// What a pixel of a keyframe shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum PixelClass {
    /// Neither known to be object nor known to be empty: no loss.
    Ignored = 0,
    /// A measured point on the object: colour and depth count.
    Foreground = 1,
    /// Measured to be empty inside the clip box: alpha should be 0.
    Free = 2,
}

/// Why a training view was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ViewError {
    /// A buffer does not fit the camera.
    #[error("{what} has {found} pixels, but the camera is {width}x{height}: give {} pixels", width * height)]
    Size {
        /// Which buffer.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The camera's width.
        width: u32,
        /// The camera's height.
        height: u32,
    },
    /// The camera cannot project.
    #[error("the camera is not usable (size, focal length or pose not finite and positive): {0}")]
    Camera(String),
    /// A colour is not a number.
    #[error("colour of pixel ({x}, {y}) is not finite")]
    Color {
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
}

/// Bits of one tile: row y, column x is bit x of element y.
pub(crate) type TileMask = [u16; TILE];

/// One tile of the target.
#[derive(Clone)]
pub(crate) struct TargetTile {
    /// Colour over grey 0.5 outside of the foreground, and 0 outside of the image.
    pub color: [Plane; 3],
    pub depth: Plane,
    pub inside: TileMask,
    pub foreground: TileMask,
    pub free: TileMask,
    pub has_depth: TileMask,
}

/// A keyframe prepared for training. About 17 bytes a pixel; nothing of it changes during training.
#[derive(Clone)]
pub struct TrainingView {
    id: u64,
    camera: Camera,
    pub(crate) tiles: Vec<TargetTile>,
    pub(crate) foreground: usize,
    pub(crate) free: usize,
    pub(crate) with_depth: usize,
}

impl TrainingView {
    /// Prepares a keyframe. `color` (0 to 1), `depth_m` (centre z, 0 = no measurement) and `class` are row by row, of the
    /// camera's size. Depth counts on foreground pixels only.
    ///
    /// # Errors
    /// Where sizes differ, the camera cannot project or a colour is not finite. Depths that are not positive and
    /// finite count as not measured.
    pub fn new(camera: Camera, color: &[[f32; 3]], depth_m: &[f32], class: &[PixelClass]) -> Result<Self, ViewError> {
        if !camera.is_valid() {
            return Err(ViewError::Camera(format!("{camera:?}")));
        }
        let pixels = camera.pixels();
        for (what, found) in [("colour", color.len()), ("depth", depth_m.len()), ("class", class.len())] {
            if found != pixels {
                return Err(ViewError::Size { what, found, width: camera.width, height: camera.height });
            }
        }
        let (width, height) = (camera.width as usize, camera.height as usize);
        if let Some(bad) = color.iter().position(|c| c.iter().any(|v| !v.is_finite())) {
            return Err(ViewError::Color { x: bad % width, y: bad / width });
        }
        let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let id = NEXT.fetch_add(1, Ordering::Relaxed);
        let mut view =
            Self { id, camera, tiles: Vec::with_capacity(tiles_x * tiles_y), foreground: 0, free: 0, with_depth: 0 };
        for ty in 0..tiles_y {
            for tx in 0..tiles_x {
                let mut tile = TargetTile {
                    color: [Plane::ZERO; 3],
                    depth: Plane::ZERO,
                    inside: [0; TILE],
                    foreground: [0; TILE],
                    free: [0; TILE],
                    has_depth: [0; TILE],
                };
                for y in 0..TILE.min(height - ty * TILE) {
                    for x in 0..TILE.min(width - tx * TILE) {
                        let from = (ty * TILE + y) * width + tx * TILE + x;
                        let (to, bit) = (y * TILE + x, 1 << x);
                        tile.inside[y] |= bit;
                        let foreground = class[from] == PixelClass::Foreground;
                        for k in 0..3 {
                            tile.color[k].0[to] = if foreground { color[from][k] } else { 0.5 };
                        }
                        let depth = depth_m[from];
                        if foreground {
                            tile.foreground[y] |= bit;
                            view.foreground += 1;
                            if depth > 0.0 && depth.is_finite() {
                                tile.depth.0[to] = depth;
                                tile.has_depth[y] |= bit;
                                view.with_depth += 1;
                            }
                        } else if class[from] == PixelClass::Free {
                            tile.free[y] |= bit;
                            view.free += 1;
                        }
                    }
                }
                view.tiles.push(tile);
            }
        }
        Ok(view)
    }

    /// Prepares a keyframe whose every pixel counts, as the paper has it: colour over the whole image, depth where it
    /// was measured, nothing free.
    ///
    /// # Errors
    /// As [`TrainingView::new`].
    pub fn full_image(camera: Camera, color: &[[f32; 3]], depth_m: &[f32]) -> Result<Self, ViewError> {
        Self::new(camera, color, depth_m, &vec![PixelClass::Foreground; color.len()])
    }

    /// Tells views apart, in this process: a GPU keeps what it has of each by it.
    pub fn id(&self) -> u64 {
        self.id
    }

    /// The keyframe's camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Number of foreground pixels.
    pub fn foreground_pixels(&self) -> usize {
        self.foreground
    }
}
