//! An S3 server of the tests' own: `s3s-fs`, which `scripts/s3_server.sh` builds, or Garage; `TCGS_S3_SERVER` names it.
//!
//! One for the process and its children, over a temporary folder and a port of its own. A shell waits for the end of its standard input,
//! which comes with the end of this process however it ends, and then stops the server and removes the folder.

use std::{
    env,
    io::{BufRead as _, BufReader},
    net::{SocketAddr, TcpListener, TcpStream},
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::{
        Arc, LazyLock,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use object_store::ObjectStore;
use tcgs::store::BucketUrl;

use super::skip::skip;

/// Longest wait for a server to start.
const LONGEST: Duration = Duration::from_secs(60);

const BUCKET: &str = "scenes";
/// As Garage wants it.
const KEY: &str = "GK0123456789abcdef01234567";
/// Nothing may show it.
pub const SECRET: &str = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";

/// Runs the program with its arguments until standard input ends.
const SCRIPT: &str = r#"
folder=$1
shift
"$@" >"$folder/server.log" 2>&1 &
trap '' INT TERM HUP
echo started
cat >/dev/null
kill -9 $!
rm -rf "$folder"
"#;

/// A running server.
pub struct S3Server {
    pub address: SocketAddr,
    _shell: Child,
}

static SHARED: LazyLock<Option<S3Server>> = LazyLock::new(S3Server::start);
static NEXT: AtomicU32 = AtomicU32::new(0);

impl S3Server {
    /// The server of this process. Where there is none, says that the test is skipped.
    #[track_caller]
    pub fn shared() -> Option<&'static Self> {
        if SHARED.is_none() {
            skip("TCGS_S3_SERVER names no S3 server; 'scripts/s3_server.sh' builds one and prints its path");
        }
        SHARED.as_ref()
    }

    fn start() -> Option<Self> {
        let program = PathBuf::from(env::var_os("TCGS_S3_SERVER")?);
        let folder = tempfile::Builder::new().prefix("tcgs-s3-").tempdir().expect("a folder").keep();
        let port = || TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound");
        let address = port();
        let mut command = Command::new("sh");
        command.args(["-c", SCRIPT, "sh"]).arg(&folder).arg(&program);
        if program.file_name().is_some_and(|name| name == "garage") {
            let config = folder.join("garage.toml");
            let text = format!(
                "metadata_dir = '{0}/meta'\ndata_dir = '{0}/data'\ndb_engine = 'sqlite'\nreplication_factor = 1\n\
                 rpc_bind_addr = '{1}'\nrpc_public_addr = '{1}'\nrpc_secret = '{SECRET}'\n\
                 [s3_api]\ns3_region = 'garage'\napi_bind_addr = '{address}'\n",
                folder.display(),
                port(),
            );
            std::fs::write(&config, text).expect("written");
            command.arg("-c").arg(&config).args([
                "server",
                "--single-node",
                "--default-access-key",
                "--default-bucket",
            ]);
            command.envs([
                ("GARAGE_DEFAULT_ACCESS_KEY", KEY),
                ("GARAGE_DEFAULT_SECRET_KEY", SECRET),
                ("GARAGE_DEFAULT_BUCKET", BUCKET),
            ]);
        } else {
            let root = folder.join("data");
            std::fs::create_dir_all(root.join(BUCKET)).expect("made");
            command.args(["--host", "127.0.0.1", "--port", &address.port().to_string()]);
            command.args(["--access-key", KEY, "--secret-key", SECRET]).arg(root);
        }
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut shell = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a shell runs");
        let mut said = String::new();
        let stdout = shell.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut said).expect("read");
        let begun = Instant::now();
        while TcpStream::connect(address).is_err() {
            let log = std::fs::read_to_string(folder.join("server.log")).unwrap_or_default();
            assert!(begun.elapsed() < LONGEST, "{} does not start: {log}", program.display());
            std::thread::sleep(Duration::from_millis(20));
        }
        Some(Self { address, _shell: shell })
    }

    /// An address that no other test has.
    pub fn prefix(&self) -> BucketUrl {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        format!("s3://{BUCKET}/test-{number}").parse().expect("an address")
    }

    /// Access to an address, directly.
    pub fn connect(&self, url: &BucketUrl) -> Arc<dyn ObjectStore> {
        connect(url, self.address)
    }

    /// The variables that the program needs for it.
    pub fn variables(&self) -> Vec<(String, String)> {
        variables(self.address)
    }
}

/// Access to an address at a server, or what stands before it.
pub fn connect(url: &BucketUrl, server: SocketAddr) -> Arc<dyn ObjectStore> {
    url.connect_with(variables(server)).expect("usable variables")
}

/// The variables that the program needs for a server, or what stands before it.
pub fn variables(server: SocketAddr) -> Vec<(String, String)> {
    [
        ("AWS_ENDPOINT_URL", format!("http://{server}")),
        ("AWS_REGION", "garage".to_owned()),
        ("AWS_ACCESS_KEY_ID", KEY.to_owned()),
        ("AWS_SECRET_ACCESS_KEY", SECRET.to_owned()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}
