//! What became of a mission, from what it left.

use std::path::Path;

use crate::common::{journal, keyframes};
use crate::record::Mission;

/// Ids from here on are views of the prior, of which only the newest counts.
const PRIOR_IDS: u64 = 1_000_000;

/// Fills in what the folder tells.
pub fn judge(mission: &mut Mission, folder: &Path) {
    if !folder.join("mission.toml").exists() {
        // Launch died before the mission was; there is nothing to lose.
        "complete".clone_into(&mut mission.end_reason);
        return;
    }
    let entries = journal(folder);
    let reason = entries.iter().rev().find(|entry| entry["event"] == "over").map(|entry| entry["reason"].clone());
    mission.end_reason = reason.and_then(|reason| Some(reason.as_str()?.to_owned())).unwrap_or_default();
    let there = keyframes(folder);
    let wanted = entries.iter().filter(|entry| entry["event"] == "captured").filter_map(|e| e["keyframe_id"].as_u64());
    let mut captured: Vec<u64> = wanted.filter(|id| *id < PRIOR_IDS).collect();
    let all = captured.len();
    captured.sort_unstable();
    captured.dedup();
    mission.doubled = all - captured.len();
    let dropped = entries.iter().filter(|entry| entry["event"] == "dropped").count();
    mission.lost = captured.iter().filter(|id| !there.contains(id)).count() + dropped;
    let stamps: Vec<u64> = entries.iter().filter_map(|entry| entry["now_ns"].as_u64()).collect();
    if !stamps.is_sorted() {
        mission.error += " the journal's time goes back";
    }
    let text = std::fs::read_to_string(folder.join("report/metrics.json")).unwrap_or_default();
    match serde_json::from_str::<serde_json::Value>(&text) {
        Ok(metrics) => {
            mission.psnr_db = metrics["live"]["psnr_object_db"].as_f64();
            mission.clearance_m = metrics["mission"]["min_clearance_m"].as_f64();
            mission.collisions = metrics["mission"]["collisions"].as_u64().unwrap_or(0);
        }
        Err(error) => mission.error += &format!(" metrics.json: {error}"),
    }
}
