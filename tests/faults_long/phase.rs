//! Where a mission is, from its journal.

use std::path::Path;

/// The phases, in their order.
pub const PHASES: [&str; 11] = [
    "start-up",
    "prior",
    "seed orbit",
    "transit",
    "capture",
    "training",
    "scoring",
    "selection",
    "return",
    "landing",
    "shutdown",
];

/// The phase of the mission in a folder. Training goes on beside flight: it is the phase where nothing else is going on.
pub fn of(folder: &Path) -> &'static str {
    let text = std::fs::read_to_string(folder.join("journal.jsonl")).unwrap_or_default();
    let Some(last) = text.lines().rev().find_map(|line| serde_json::from_str::<serde_json::Value>(line).ok()) else {
        return "start-up";
    };
    let word = |key: &str| last[key].as_str().unwrap_or_default();
    match word("event") {
        "target" => match word("purpose") {
            "prior-overhead" | "prior-side" | "check-overhead" | "check-side" | "scan" => "prior",
            "seed" => "seed orbit",
            "home" => "return",
            _ => "transit",
        },
        "capture" | "captured" | "capture-failed" => "capture",
        "prior" => "prior",
        "round" | "round-done" => "training",
        "score" => "scoring",
        "selected" => "selection",
        "ending" => "return",
        "command" if word("command") == "land" => "landing",
        "landed" => "landing",
        "over" => "shutdown",
        _ => "start-up",
    }
}
