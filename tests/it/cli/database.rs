//! The address of a PostgreSQL database on the command line: its password is in no error and no log.

use crate::support::program;

const PASSWORD: &str = "s3cret";

#[test]
fn no_password_of_a_database_is_shown() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let keys = ["keys", "list"];
    let serve = ["serve", "--listen=127.0.0.1:0"];
    let cases = [
        // Nobody listens there.
        (serve, "postgres://ann:s3cret@127.0.0.1:1/tcgs", 4, "postgres://ann@127.0.0.1:1/tcgs"),
        (serve, "postgres://ann:s3cret@%2Fnowhere/tcgs", 4, "postgres://ann@/nowhere/tcgs"),
        (keys, "postgres://ann@%2Fnowhere/tcgs?password=s3cret", 4, "postgres://ann@/nowhere/tcgs"),
        (["migrate", "--json"], "postgres://ann:s3cret@%2Fnowhere/tcgs", 4, "postgres://ann@/nowhere/tcgs"),
        (keys, "postgres://ann:1/s3cret@127.0.0.1:1/tcgs", 2, "--database"),
        (keys, "postgres://ann@127.0.0.1:1/tcgs?passwd=s3cret", 2, "passwd"),
        (serve, "mysql://ann:s3cret@127.0.0.1/tcgs", 2, "--database"),
    ];
    for (command, address, status, word) in cases {
        let mut program = program::command();
        program.args(command).env("TCGS_DATABASE", address).env("RUST_LOG", "trace");
        let output = program.arg("--data").arg(folder.path()).output().expect("the binary runs");
        let told = [output.stdout, output.stderr].concat();
        let told = String::from_utf8_lossy(&told);
        assert_eq!(output.status.code(), Some(status), "{command:?} {address}: {told}");
        assert!(told.contains(word), "{command:?} {address}: {told}");
        assert!(!told.contains(PASSWORD), "{command:?} {address}: {told}");
    }
}
