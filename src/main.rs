//! The command line: parses, runs one command, and turns what came of it into output and an exit status.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
