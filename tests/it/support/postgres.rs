//! A PostgreSQL server of the tests' own, from the machine's packages (Debian's is `postgresql`).
//!
//! One for the process and its children, over a temporary folder and a socket in it, without TCP. A shell waits for the end of its standard
//! input, which comes with the end of this process however it ends, and then stops the server and removes the folder. Its default collation
//! is not the order of bytes, so that tests find what relies on one.

use std::{
    fs,
    io::{BufRead as _, BufReader, Write as _},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, Command, Stdio},
    sync::{
        LazyLock,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use sqlx::{Connection as _, PgConnection};
use tcgs::{
    domain::SystemClock,
    store::{PostgresUrl, QueuePolicy, Store},
};
use tokio::sync::OnceCell;

use super::skip::skip;

/// Longest wait for a server to start or to stop.
const LONGEST: Duration = Duration::from_secs(60);

/// Makes the folder a server's, and runs it until standard input ends. A line `stop` or `start` on it stops and starts the server; each is
/// answered by a line.
const SCRIPT: &str = r#"
set -eu
bin=$1 folder=$2
export PATH="$bin:$PATH" LC_ALL=C.UTF-8
trap 'pg_ctl -D "$folder/data" -m immediate stop >/dev/null 2>&1 || true; rm -rf "$folder"' EXIT
trap '' INT TERM HUP
initdb -D "$folder/data" -U tcgs -A trust -E UTF8 --no-sync --locale-provider=icu --icu-locale=en-US >"$folder/initdb.log" 2>&1 ||
    { cat "$folder/initdb.log"; exit 1; }
start() {
    pg_ctl -D "$folder/data" -w -t 60 -l "$folder/server.log" -o "-k $folder -c listen_addresses='' -c fsync=off \
        -c full_page_writes=off -c max_connections=400 -c shared_buffers=64MB -c log_lock_waits=on -c deadlock_timeout=500ms" start >/dev/null
}
start
echo started
while read -r order; do
    case $order in
    stop) pg_ctl -D "$folder/data" -w -m fast stop >/dev/null ;;
    start) start ;;
    esac
    echo done
done
"#;

/// The password in the addresses of databases, which the server does not ask for. Nothing may show it.
pub const PASSWORD: &str = "never-shown";

/// A running server.
pub struct Cluster {
    folder: PathBuf,
    shell: std::sync::Mutex<Shell>,
    template: OnceCell<()>,
    next: AtomicU32,
}

struct Shell {
    orders: ChildStdin,
    answers: BufReader<std::process::ChildStdout>,
    _child: Child,
}

static SHARED: LazyLock<Option<Cluster>> = LazyLock::new(Cluster::start);

/// One database of a server. Dropping it deletes it.
pub struct PostgresDatabase {
    name: String,
    folder: PathBuf,
}

/// The oldest version that the program works with.
const OLDEST: u32 = 15;

/// The folder of the server's programs: Debian's newest, else the first on the path.
fn programs() -> Option<PathBuf> {
    let versions = fs::read_dir("/usr/lib/postgresql").into_iter().flatten();
    let versions = versions.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    let mut versions: Vec<u32> = versions.filter(|version| *version >= OLDEST).collect();
    versions.sort();
    let debian = versions.iter().rev().map(|version| format!("/usr/lib/postgresql/{version}/bin").into());
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut all = debian.chain(std::env::split_paths(&path));
    all.find(|folder| ["initdb", "postgres", "pg_ctl"].iter().all(|name| folder.join(name).exists()))
}

/// User and group that a server of root's runs as, which refuses root's rights.
fn unprivileged() -> Option<(u32, u32)> {
    let is_root = fs::metadata("/proc/self").map(|own| std::os::unix::fs::MetadataExt::uid(&own) == 0);
    if !is_root.unwrap_or(false) {
        return None;
    }
    let users = fs::read_to_string("/etc/passwd").expect("users");
    let user = |name: &str| {
        let line = users.lines().find(|line| line.split(':').next() == Some(name))?;
        let mut ids = line.split(':').skip(2).map(|id| id.parse().expect("an id"));
        Some((ids.next()?, ids.next()?))
    };
    user("postgres").or_else(|| user("nobody"))
}

impl Cluster {
    /// The server of this process. Where PostgreSQL is not installed, says that the test is skipped.
    #[track_caller]
    pub fn shared() -> Option<&'static Self> {
        if SHARED.is_none() {
            skip("PostgreSQL is not installed; 'scripts/setup.sh --for-tests' installs it");
        }
        SHARED.as_ref()
    }

    /// A server that this test alone stops and starts.
    #[track_caller]
    pub fn own() -> Option<Self> {
        Self::shared()?;
        Self::start()
    }

    fn start() -> Option<Self> {
        let programs = programs()?;
        // The paths of sockets are short, and TMPDIR may be closed to the server's user.
        let parent = if Path::new("/tmp").is_dir() { "/tmp".into() } else { std::env::temp_dir() };
        let folder = tempfile::Builder::new().prefix("tcgs-pg-").tempdir_in(parent).expect("a folder").keep();
        let mut command = Command::new("sh");
        command.args(["-c", SCRIPT, "sh"]).arg(&programs).arg(&folder).current_dir("/");
        if let Some((user, group)) = unprivileged() {
            std::os::unix::fs::chown(&folder, Some(user), Some(group)).expect("its own folder");
            std::os::unix::process::CommandExt::uid(&mut command, user);
            std::os::unix::process::CommandExt::gid(&mut command, group);
        }
        // Of its own group, so that an interrupt on the terminal leaves it to the end of its input.
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a shell runs");
        let mut answers = BufReader::new(child.stdout.take().expect("piped"));
        let mut said = String::new();
        while !said.ends_with("started\n") {
            assert!(answers.read_line(&mut said).expect("read") > 0, "PostgreSQL does not start:\n{said}");
        }
        let orders = child.stdin.take().expect("piped");
        let shell = std::sync::Mutex::new(Shell { orders, answers, _child: child });
        Some(Self { folder, shell, template: OnceCell::new(), next: AtomicU32::new(0) })
    }

    fn order(&self, order: &str) {
        let mut shell = self.shell.lock().expect("not poisoned");
        writeln!(shell.orders, "{order}").expect("written");
        let (mut said, begun) = (String::new(), Instant::now());
        assert!(shell.answers.read_line(&mut said).expect("read") > 0, "the server's shell has ended");
        assert!(begun.elapsed() < LONGEST);
    }

    /// Stops the server; connections end.
    pub fn stop(&self) {
        self.order("stop");
    }

    /// Starts the server again.
    pub fn restart(&self) {
        self.order("start");
    }

    /// A new database with the tables of this program.
    pub async fn database(&self) -> PostgresDatabase {
        self.template
            .get_or_init(async || {
                run(&self.folder, "CREATE DATABASE template_tcgs").await;
                let store = Store::open(
                    tcgs::store::DatabaseLocation::Postgres(url(&self.folder, "template_tcgs")),
                    std::sync::Arc::new(SystemClock),
                    QueuePolicy::default(),
                );
                store.await.expect("migrated").close().await;
            })
            .await;
        self.create("TEMPLATE template_tcgs").await
    }

    /// A new database without tables.
    pub async fn empty_database(&self) -> PostgresDatabase {
        self.create("").await
    }

    async fn create(&self, how: &str) -> PostgresDatabase {
        // The copy of a template must not be connected to.
        static ONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());
        let _one = ONE.lock().await;
        let name = format!("test_{}", self.next.fetch_add(1, Ordering::Relaxed));
        run(&self.folder, &format!("CREATE DATABASE {name} {how}")).await;
        PostgresDatabase { name, folder: self.folder.clone() }
    }
}

impl PostgresDatabase {
    /// Its address.
    pub fn url(&self) -> PostgresUrl {
        url(&self.folder, &self.name)
    }

    /// The server's socket, for a proxy before it.
    pub fn socket(&self) -> PathBuf {
        self.folder.join(".s.PGSQL.5432")
    }

    /// Its address at a proxy.
    pub fn url_at(&self, proxy: std::net::SocketAddr) -> PostgresUrl {
        format!("postgres://tcgs:{PASSWORD}@{proxy}/{}", self.name).parse().expect("an address")
    }

    /// Ends all connections of others to it.
    pub async fn disconnect_all(&self) {
        let statement =
            format!("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{}'", self.name);
        run(&self.folder, &statement).await;
    }
}

impl Drop for PostgresDatabase {
    fn drop(&mut self) {
        let (folder, name) = (self.folder.clone(), self.name.clone());
        // On a thread of its own, since the test's runtime cannot wait here. If the server is gone, so is the database.
        let deleted = std::thread::spawn(move || {
            let runtime =
                tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async {
                if let Ok(mut connection) = PgConnection::connect(url(&folder, "postgres").expose()).await {
                    let statement = sqlx::AssertSqlSafe(format!("DROP DATABASE {name} WITH (FORCE)"));
                    let _ = sqlx::raw_sql(statement).execute(&mut connection).await;
                }
            });
        });
        let _ = deleted.join();
    }
}

fn url(folder: &Path, database: &str) -> PostgresUrl {
    let socket = folder.to_str().expect("UTF-8").replace('/', "%2F");
    format!("postgres://tcgs:{PASSWORD}@{socket}/{database}").parse().expect("an address")
}

async fn run(folder: &Path, statement: &str) {
    let mut connection = PgConnection::connect(url(folder, "postgres").expose()).await.expect("a connection");
    sqlx::raw_sql(sqlx::AssertSqlSafe(statement.to_owned())).execute(&mut connection).await.expect("it runs");
}
