//! The `vantage` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    launch::main()
}
