//! Which images are trained on and which are held out: every eighth in the order of names, as 3DGS does.

use crate::dataset::{Entry, Listing};
use crate::error::DatasetError;

/// Indices into a dataset's images.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Split {
    /// Trained on.
    pub training: Vec<usize>,
    /// Never trained on.
    pub held_out: Vec<usize>,
}

/// Splits a dataset: images 0, `hold_out`, 2 `hold_out`, .. are held out (0: none), unless the dataset says itself which are.
///
/// # Errors
/// [`DatasetError::TooFew`] where fewer than two images are left to train on.
pub fn split(listing: &Listing, hold_out: usize) -> Result<Split, DatasetError> {
    let is_held_out = |(index, entry): (usize, &Entry)| match entry.held_out {
        Some(held_out) => held_out && hold_out > 0,
        None => hold_out > 0 && index % hold_out == 0,
    };
    let (held_out, training): (Vec<usize>, Vec<usize>) =
        (0..listing.entries.len()).partition(|&index| is_held_out((index, &listing.entries[index])));
    if training.len() < 2 {
        let (root, images) = (listing.root.clone(), listing.entries.len());
        return Err(DatasetError::TooFew { root, images, training: training.len(), hold_out });
    }
    Ok(Split { training, held_out })
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use shared_types::frames::{Intrinsics, Pose};

    use super::*;
    use crate::dataset::Format;

    fn listing(held_out: &[Option<bool>]) -> Listing {
        let entry = |(index, held_out): (usize, &Option<bool>)| Entry {
            name: format!("{index:03}.png"),
            path: "x".into(),
            world_from_camera: Pose::IDENTITY,
            intrinsics: Intrinsics::from_hfov(4, 4, 1.0),
            depth: None,
            mask: None,
            held_out: *held_out,
        };
        Listing {
            root: "scene".into(),
            format: Format::Colmap,
            entries: held_out.iter().enumerate().map(entry).collect(),
            points: Vec::new(),
            up: Vec3::Z,
            stage: None,
            downscale: 1,
        }
    }

    #[test]
    fn every_eighth_is_held_out_beginning_with_the_first() {
        let split = split(&listing(&[None; 18]), 8).expect("enough");
        assert_eq!(split.held_out, [0, 8, 16]);
        assert_eq!(split.training.len(), 15);
        let all = super::split(&listing(&[None; 3]), 0).expect("enough");
        assert_eq!((all.training.len(), all.held_out.len()), (3, 0));
    }

    #[test]
    fn a_dataset_s_own_test_views_are_held_out_instead() {
        let split = split(&listing(&[Some(false), Some(false), Some(true), Some(false)]), 8).expect("enough");
        assert_eq!((split.training, split.held_out), (vec![0, 1, 3], vec![2]));
    }

    #[test]
    fn two_images_are_needed_for_training() {
        let message = split(&listing(&[None; 2]), 8).expect_err("one is left").to_string();
        assert!(message.contains("2 usable images, of which 1 are left"), "{message}");
        let message = split(&listing(&[None; 9]), 1).expect_err("none is left").to_string();
        assert!(message.contains("0 are left for training once all are held out"), "{message}");
        let message = split(&listing(&[None; 1]), 0).expect_err("one").to_string();
        assert!(message.contains("1 are left for training; expected at least 2: add images"), "{message}");
        assert!(split(&listing(&[]), 8).is_err());
    }
}
