//! What `vantage status` tells people.

use std::fmt::Write as _;

use super::SystemReport;

/// A system in words; with all channels, or without.
pub fn describe(report: &SystemReport, channels: bool) -> String {
    let mut text = format!("system {} in {}", report.system, report.folder);
    match (report.supervisor_pid, report.supervised) {
        (0, _) => text.push_str(", no supervisor\n"),
        (pid, true) => writeln!(text, ", supervisor {pid}").unwrap_or(()),
        (pid, false) => {
            writeln!(text, ", supervisor {pid} is gone: `vantage doctor --clean` removes what is left").unwrap_or(())
        }
    }
    match report.condition {
        "dead" => {
            text.push_str("dead: `vantage doctor --clean` removes it\n");
            return text;
        }
        "does not answer" => {
            text.push_str("does not answer: is its keeper running? (`vantage keeper --system NAME`)\n");
            return text;
        }
        _ => {}
    }
    if let Some(mission) = &report.mission {
        writeln!(text, "mission {mission}").ok();
    }
    if report.services.is_empty() {
        text.push_str("no service was heard\n");
        return text;
    }
    let header = format!(
        "{:<10} {:>7} {:<9} {:>8} {:>8} {:>7} {:>4} {:>8} {:>19} {:>14} {:>9} {:>9} {:>7}",
        "service",
        "pid",
        "state",
        "restarts",
        "age",
        "heard",
        "nice",
        "memory",
        "own/program/shared",
        "turn p50/p99",
        "received",
        "sent",
        "lost"
    );
    writeln!(text, "{header}").ok();
    for row in &report.services {
        let or_dash = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        let [received, sent, lost] = row.messages;
        writeln!(
            text,
            "{:<10} {:>7} {:<9} {:>8} {:>8} {:>7} {:>4} {:>8} {:>19} {:>14} {received:>9} {sent:>9} {lost:>7}  {}",
            row.service,
            row.pid,
            if row.alive { row.state.as_str() } else { "gone" },
            row.restarts,
            or_dash(row.age_s.map(|age| format!("{age:.0} s"))),
            or_dash(row.heard_s.map(|age| format!("{age:.1} s"))),
            or_dash(row.nice.map(|nice| nice.to_string())),
            or_dash(row.pss_mb.map(|mb| format!("{mb:.1} MB"))),
            or_dash(row.memory_mb.map(|mb| format!("{:.1}/{:.1}/{:.1}", mb.anonymous, mb.file, mb.shared))),
            format!("{:.2}/{:.2} ms", row.turn_p50_ms, row.turn_p99_ms),
            row.last_error
        )
        .ok();
    }
    if channels {
        describe_channels(report, &mut text);
    }
    text
}

fn describe_channels(report: &SystemReport, text: &mut String) {
    let header = format!(
        "\n{:<24} {:>7} {:>7} {:>5} {:>10} {:>10} {:>7}",
        "channel", "senders", "readers", "queue", "memory", "rate", "heard"
    );
    writeln!(text, "{header}").ok();
    for row in &report.channels {
        let census = &row.census;
        #[expect(clippy::cast_precision_loss, reason = "a figure for people")]
        let megabytes = census.segment_bytes as f64 / 1e6;
        writeln!(
            text,
            "{:<24} {:>7} {:>7} {:>5} {:>10} {:>10} {:>7}",
            census.channel,
            census.publishers,
            census.subscribers,
            census.queue,
            format!("{megabytes:.2} MB"),
            row.rate_hz.map_or_else(|| "-".to_owned(), |rate| format!("{rate:.1} /s")),
            row.heard_s.map_or_else(|| "-".to_owned(), |age| format!("{age:.1} s"))
        )
        .ok();
    }
}
