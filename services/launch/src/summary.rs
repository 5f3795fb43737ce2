//! The table at the end of a mission.

use std::fmt::Write as _;
use std::path::Path;

use crate::evaluate::Metrics;

/// The figures for people. What was not measured is left out.
#[must_use]
pub fn table(metrics: &Metrics, folder: &Path) -> String {
    let mission = &metrics.mission;
    let live = &metrics.live;
    let db = |value: Option<f64>| value.map(|db| format!("{db:.2} dB"));
    let percent = |value: Option<f64>| value.map(|share| format!("{:.1} %", share * 100.0));
    let seconds = |value: Option<f64>| value.map(|time| format!("{time:.1} s"));
    let number = |value: Option<u64>| value.map(|count| count.to_string());
    let restarts: Vec<String> =
        mission.restarts.iter().flatten().map(|(service, count)| format!("{service} {count}")).collect();
    let estimator = mission.estimator.as_deref().map_or(String::new(), |name| format!(" (estimator {name})"));
    let rows: Vec<(String, Option<String>)> = vec![
        ("end".to_owned(), mission.end_reason.clone()),
        ("keyframes".to_owned(), number(mission.keyframes.map(|count| count as u64))),
        ("mission time".to_owned(), seconds(mission.mission_s)),
        ("wall time".to_owned(), seconds(mission.wall_s)),
        ("path".to_owned(), mission.path_m.map(|path| format!("{path:.1} m"))),
        ("least clearance".to_owned(), mission.min_clearance_m.map(|least| format!("{least:.2} m"))),
        ("collisions".to_owned(), mission.collisions.filter(|count| *count > 0).map(|count| count.to_string())),
        ("training iterations".to_owned(), number(mission.iterations.map(u64::from))),
        ("Gaussians".to_owned(), number(live.gaussians.map(|count| count as u64))),
        (format!("PSNR object, held-out, R{estimator}"), db(live.psnr_object_db)),
        (format!("PSNR object, held-out, 0.8 R{estimator}"), db(live.psnr_object_near_db)),
        ("PSNR whole image, held-out, R".to_owned(), db(live.psnr_frame_db)),
        ("SSIM object, held-out, R".to_owned(), live.ssim_object.map(|ssim| format!("{ssim:.4}"))),
        ("PSNR training views".to_owned(), db(live.psnr_train_db)),
        ("PSNR of the mean colour".to_owned(), db(live.psnr_null_db)),
        ("PSNR inserted, untrained".to_owned(), db(live.psnr_init_db)),
        ("coverage, paper".to_owned(), percent(metrics.coverage.paper)),
        ("surface seen twice, of the feasible".to_owned(), percent(metrics.coverage.cov2_feasible)),
        ("area under that curve".to_owned(), percent(metrics.coverage.auc)),
        ("F-score at 1 % of the diameter".to_owned(), percent(metrics.geometry.f_score_1pct)),
        ("memory, all services".to_owned(), metrics.memory.get("total_pss_mb").map(|mb| format!("{mb:.0} MB"))),
        ("restarts".to_owned(), (!restarts.is_empty()).then(|| restarts.join(", "))),
        ("repeats bit for bit".to_owned(), mission.deterministic.map(|yes| if yes { "yes" } else { "no" }.to_owned())),
    ];
    let shown: Vec<(String, String)> = rows.into_iter().filter_map(|(name, value)| Some((name, value?))).collect();
    let width = shown.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let mut text = String::new();
    for (name, value) in shown {
        writeln!(text, "{name:<width$}  {value}").ok();
    }
    writeln!(text, "\nmission folder  {}", folder.display()).ok();
    writeln!(text, "figures         {}", folder.join("report/metrics.json").display()).ok();
    writeln!(text, "pictures        {}", folder.join("report/{north,east,south,west}.png").display()).ok();
    writeln!(text, "model           {}", folder.join("model/model.ply").display()).ok();
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_measured_has_no_row_and_values_line_up() {
        let mut metrics = Metrics::default();
        metrics.live.psnr_object_db = Some(32.815);
        metrics.mission.estimator = Some("vio".to_owned());
        metrics.mission.keyframes = Some(48);
        let text = table(&metrics, Path::new("/m"));
        assert!(text.contains("PSNR object, held-out, R (estimator vio)  32.8"), "{text}");
        assert!(text.contains("keyframes                                 48\n"), "{text}");
        assert!(!text.contains("SSIM") && !text.contains("restarts"));
        assert!(text.contains("/m/report/metrics.json"));
    }
}
