//! What a model is worth on images that it never saw: means of PSNR and SSIM over them.

use splatting::metrics::{masked_ssim, psnr};
use splatting::{Engine, EngineError, Gaussians, RenderSettings, Rendered};

use crate::dataset::Image;

/// PSNR of an image without error, dB: what 16 bits could show.
pub const PSNR_MAX_DB: f64 = 100.0;

/// Means over images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quality {
    /// PSNR over the pixels that count: all of a plain image, the inside of a mask or of a mission's box, dB.
    pub psnr_db: f64,
    /// SSIM over the same.
    pub ssim: f64,
    /// PSNR over whole images, dB.
    pub frame_psnr_db: f64,
}

/// Measures a model on images, one image per thread. `None` without images, or where no pixel counts.
///
/// # Errors
/// Where the system refuses threads.
pub fn evaluate(
    model: &Gaussians,
    images: &[&Image],
    settings: &RenderSettings,
    threads: usize,
) -> Result<Option<Quality>, EngineError> {
    let share = images.len().div_ceil(threads.max(1)).max(1);
    let parts = std::thread::scope(|scope| {
        let work = |part: &[&Image]| -> Result<Vec<Option<Quality>>, EngineError> {
            let mut engine = Engine::new(1)?;
            let mut rendered = Rendered::default();
            Ok(part
                .iter()
                .map(|image| {
                    engine.render(model, &image.camera, settings, &mut rendered);
                    of_image(image, &rendered.color)
                })
                .collect())
        };
        let handles: Vec<_> = images.chunks(share).map(|part| scope.spawn(move || work(part))).collect();
        handles
            .into_iter()
            .map(|handle| handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect::<Result<Vec<_>, _>>()
    })?;
    // Summed in the order of the images, whatever the number of threads.
    let each: Vec<Quality> = parts.into_iter().flatten().flatten().collect();
    let mean = |value: fn(&Quality) -> f64| each.iter().map(value).sum::<f64>() / each.len() as f64;
    Ok((!each.is_empty()).then(|| Quality {
        psnr_db: mean(|quality| quality.psnr_db),
        ssim: mean(|quality| quality.ssim),
        frame_psnr_db: mean(|quality| quality.frame_psnr_db),
    }))
}

fn of_image(image: &Image, rendered: &[[f32; 3]]) -> Option<Quality> {
    let truth = image.colors.to_f32();
    let (width, height) = (image.camera.width as usize, image.camera.height as usize);
    let inside = image.foreground().unwrap_or_else(|| vec![true; truth.len()]);
    Some(Quality {
        psnr_db: psnr(rendered, &truth, Some(&inside))?.min(PSNR_MAX_DB),
        ssim: masked_ssim(rendered, &truth, &inside, width, height)?,
        frame_psnr_db: psnr(rendered, &truth, None)?.min(PSNR_MAX_DB),
    })
}
