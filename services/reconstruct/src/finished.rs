//! A run that is over: what its folder says of it, so that what comes after training can be made up for.

use crate::dataset;
use crate::error::ReconstructError;
use crate::options::{Identity, Options};
use crate::output::Output;
use crate::recipe::strategy_for;
use crate::report::Report;
use crate::run::load_options;
use crate::split::split;

/// The report of the run with these options on this dataset that is over; `None` where the output folder holds none, or
/// that of another run.
///
/// # Errors
/// [`ReconstructError`]: what is wrong with the dataset, the options, or the output folder.
pub fn finished(options: &Options) -> Result<Option<Report>, ReconstructError> {
    options.check()?;
    let Ok(bytes) = std::fs::read(options.out.join("metrics.json")) else { return Ok(None) };
    let Ok(report) = serde_json::from_slice::<Report>(&bytes) else { return Ok(None) };
    let Some(found) = Output::open(&options.out)?.identity()? else { return Ok(None) };
    let listing = dataset::list(&options.folder, options.images.as_deref())?;
    let split = split(&listing, options.hold_out)?;
    let dataset = dataset::load(&listing, &load_options(options))?;
    let asked = Identity::of(options, &dataset, &split, strategy_for(options, &dataset));
    Ok((found == asked && report.run == asked).then_some(report))
}
