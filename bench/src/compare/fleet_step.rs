//! Table `fleet-step`: four robots send an image each, and a server answers all once it has all four.
//!
//! Beside topics, as the paper's previous system did it: files over SSH and SFTP, with a real `sshd`. There every robot
//! keeps one SFTP session for all steps, so that no step has a handshake in it, and the server sees files without
//! asking.

use std::fs;
use std::io::ErrorKind;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::json;
use sgc_testkit::netsim::Profile;

use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::program::Program;
use super::system::{System, Topic};
use super::{Compare, Figures};
use crate::report::Spread;

const ROBOTS: usize = 4;
const IMAGES: &str = "/fleet/image";
const ACTIONS: &str = "/fleet/action";
/// Topics of each robot's images and actions.
const TOPICS: [(&str, &str); ROBOTS] = [
    ("/fleet/image_0", "/fleet/action_0"),
    ("/fleet/image_1", "/fleet/action_1"),
    ("/fleet/image_2", "/fleet/action_2"),
    ("/fleet/image_3", "/fleet/action_3"),
];
/// Bytes of an action: a header and a command for each of seven joints.
const ACTION_BYTES: usize = 128;
/// One way.
const NEAR: Duration = Duration::from_millis(5);
const FAR: Duration = Duration::from_millis(38);
/// Steps that count.
const STEPS: usize = 30;
/// Before steps count.
const WARM_UP: usize = 3;
/// How long a system may take until it carries everything.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How long a step may take.
const STEP_MAX: Duration = Duration::from_secs(30);

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let why = "the path and the robots say how long it takes, and hardly the suite";
    let systems = compare.systems_of(Breadth::Transports, "fleet-step", why, figures);
    for (name, delay) in [("near", NEAR), ("far", FAR)] {
        let profile = Profile { delay, ..Profile::default() };
        let kind = PathKind::Other(name, [profile; 2]);
        if !compare.wants_path(&kind) {
            continue;
        }
        let steps = if compare.is_quick() { 5 } else { STEPS };
        compare.note(&format!("fleet step, {name}: ssh"));
        let outcome = over_ssh(compare, kind, steps);
        push(figures, "ssh", name, outcome);
        for system in &systems {
            compare.note(&format!("fleet step, {name}: {}", system.name()));
            let outcome = over_topics(compare, kind, *system, steps);
            push(figures, &system.name(), name, outcome);
        }
    }
    Ok(())
}

/// Adds the times of steps, µs.
fn push(figures: &mut Figures, system: &str, path: &str, steps_us: Result<Vec<f64>>) {
    match steps_us {
        Err(error) => figures.leave_out(&format!("fleet-step {system} on {path}"), format!("{error:#}")),
        Ok(steps) => {
            let spread = Spread::from_samples(steps);
            let mut push = |metric, value| {
                figures.push("fleet-step", system, path, ROBOTS as f64, metric, value);
            };
            push("p50_us", spread.p50);
            push("p99_us", spread.p99);
            push("max_us", spread.max);
        }
    }
}

/// Every robot and the server are programs of their own.
fn over_topics(compare: &Compare, kind: PathKind, system: &dyn System, steps: usize) -> Result<Vec<f64>> {
    let lab = Lab::new(kind, compare.load())?;
    let topic = |name, towards| Topic { name, towards, reliable: true };
    let topics: Vec<_> = TOPICS
        .iter()
        .flat_map(|(image, action)| [topic(*image, Side::Right), topic(*action, Side::Left)])
        .collect();
    let running = system.start(&lab, &topics)?;
    let together = ROBOTS.to_string();
    let answer = [
        "answer",
        "--topic",
        IMAGES,
        "--back",
        ACTIONS,
        "--together",
        &together,
        "--reliable",
        "--node",
        "server",
    ];
    let mut server = lab.load(&running, Side::Right, &answer)?;
    server.soon("up")?;
    let mut robots = Vec::new();
    for (number, (image, action)) in TOPICS.iter().enumerate() {
        let node = format!("robot_{number}");
        let ask = ["ask", "--topic", image, "--back", action, "--reliable", "--node", &node];
        robots.push(lab.load(&running, Side::Left, &ask)?);
    }
    for robot in &mut robots {
        robot.until("connected", CONNECT_MAX)?;
    }
    let order = json!({ "ask": {
        "size": compare.fleet_image_bytes(), "answer": ACTION_BYTES, "count": 1, "warm_up": 0,
        "seconds": STEP_MAX.as_secs_f64(), "patience_seconds": STEP_MAX.as_secs_f64(),
    }});
    let mut times = Vec::new();
    for _ in 0..WARM_UP + steps {
        for robot in &mut robots {
            robot.order(&order)?;
        }
        // By the clock that they share: from the first that begins to the last that has its action.
        let (mut begun, mut ended) = (u64::MAX, 0);
        for robot in &mut robots {
            let answered = robot.until("answered", STEP_MAX * 2)?;
            ensure!(answered["lost"] == 0, "a robot got no action within {STEP_MAX:?}");
            let moment =
                |name: &str| answered[name].as_u64().with_context(|| format!("no {name} in {answered}"));
            begun = begun.min(moment("begun_ns")?);
            ended = ended.max(moment("ended_ns")?);
        }
        times.push(ended.saturating_sub(begun) as f64 / 1e3);
    }
    Ok(times.split_off(WARM_UP))
}

/// Images there and actions back as files.
fn over_ssh(compare: &Compare, kind: PathKind, steps: usize) -> Result<Vec<f64>> {
    let lab = Lab::new(kind, compare.load())?;
    let dir = lab.new_dir("ssh")?;
    let server = SshServer::start(&lab, &dir)?;
    let image = dir.join("image");
    fs::write(&image, vec![0x5a; compare.fleet_image_bytes()])?;
    let mut robots = Vec::new();
    for number in 0..ROBOTS {
        robots.push(SftpRobot::start(&lab, &server, &dir, number)?);
    }
    let mut times = Vec::new();
    for step in 0..WARM_UP + steps {
        let begun = Instant::now();
        std::thread::scope(|scope| {
            let image = &image;
            let robots = robots.iter_mut().map(|robot| scope.spawn(move || robot.step(step, image)));
            // All of them begin before the first is waited for.
            let robots: Vec<_> = robots.collect();
            let served = server.step(step, compare.fleet_image_bytes());
            for robot in robots {
                robot.join().unwrap_or_else(|_| bail!("a robot's thread ended badly"))?;
            }
            served
        })?;
        times.push(begun.elapsed().as_secs_f64() * 1e6);
    }
    // Their sessions end before the server does.
    drop(robots);
    Ok(times.split_off(WARM_UP))
}

/// Port of `sshd`.
const SSH_PORT: u16 = 2222;
/// How often the server looks for files: it is on its own disk, and may as well be told by the kernel.
const LOOK_EVERY: Duration = Duration::from_millis(1);
/// Empty directory that Debian's `sshd` needs.
const SSHD_EMPTY: &str = "/run/sshd";
const SSHD: &str = "/usr/sbin/sshd";

/// `sshd` at the right place, with keys of its own, and what is done with the files that come.
struct SshServer {
    _sshd: Program,
    address: IpAddr,
    files: PathBuf,
}

impl SshServer {
    fn start(lab: &Lab, dir: &Path) -> Result<Self> {
        ensure!(Path::new(SSHD).exists(), "{SSHD} is not installed (Debian: openssh-server)");
        fs::create_dir_all(SSHD_EMPTY).context(SSHD_EMPTY)?;
        let files = dir.join("files");
        fs::create_dir(&files)?;
        let address = lab.address(Side::Right);
        for key in ["host", "user"] {
            let mut command = Command::new("ssh-keygen");
            command.args(["-q", "-t", "ed25519", "-N", "", "-C", "", "-f"]).arg(dir.join(key));
            let status = command.status().context("ssh-keygen")?;
            ensure!(status.success(), "ssh-keygen: {status}");
        }
        let host_key = fs::read_to_string(dir.join("host.pub"))?;
        fs::write(dir.join("known"), format!("[{address}]:{SSH_PORT} {host_key}"))?;
        let dir_name = dir.display();
        let config = format!(
            "Port {SSH_PORT}\nListenAddress {address}\nHostKey {dir_name}/host\n\
             AuthorizedKeysFile {dir_name}/user.pub\nStrictModes no\nUsePAM no\n\
             PasswordAuthentication no\nKbdInteractiveAuthentication no\n\
             PermitRootLogin prohibit-password\nPidFile none\nSubsystem sftp internal-sftp\n"
        );
        fs::write(dir.join("sshd_config"), config)?;
        let mut command = lab.command(Side::Right, SSHD);
        command.args(["-D", "-e", "-f"]).arg(dir.join("sshd_config"));
        let sshd = Program::start_daemon("sshd", command, dir)?;
        Ok(Self { _sshd: sshd, address, files })
    }

    fn image(&self, robot: usize, step: usize) -> PathBuf {
        self.files.join(format!("image-{robot}-{step}"))
    }

    fn action(&self, robot: usize, step: usize) -> PathBuf {
        self.files.join(format!("action-{robot}-{step}"))
    }

    /// Waits until it has all images, and writes all actions.
    fn step(&self, step: usize, image_bytes: usize) -> Result<()> {
        let deadline = Instant::now() + STEP_MAX;
        let is_there = |robot| {
            let bytes = fs::metadata(self.image(robot, step)).map_or(0, |file| file.len());
            bytes == image_bytes as u64
        };
        while !(0..ROBOTS).all(is_there) {
            ensure!(Instant::now() < deadline, "the server has not all images after {STEP_MAX:?}");
            std::thread::sleep(LOOK_EVERY);
        }
        for robot in 0..ROBOTS {
            fs::remove_file(self.image(robot, step))?;
            // A robot that asks meanwhile finds all of it or nothing.
            let unfinished = self.files.join("unfinished");
            fs::write(&unfinished, [0x5a; ACTION_BYTES])?;
            fs::rename(&unfinished, self.action(robot, step))?;
        }
        Ok(())
    }
}

/// `sftp` at the left place, in one session.
struct SftpRobot {
    sftp: Program,
    number: usize,
    files: PathBuf,
    got: PathBuf,
}

impl SftpRobot {
    fn start(lab: &Lab, server: &SshServer, dir: &Path, number: usize) -> Result<Self> {
        let deadline = Instant::now() + CONNECT_MAX;
        loop {
            let mut command = lab.command(Side::Left, "sftp");
            let option = |name: &str, file: &str| format!("-o{name}={}", dir.join(file).display());
            command.args(["-q", "-F", "none", "-oBatchMode=yes", "-oStrictHostKeyChecking=yes"]);
            command.args([option("IdentityFile", "user"), option("UserKnownHostsFile", "known")]);
            command.args(["-oIdentitiesOnly=yes", "-P", &SSH_PORT.to_string(), "-b", "-"]);
            command.arg(server.address.to_string());
            let sftp = Program::start_daemon(&format!("sftp-{number}"), command, dir)?;
            let got = dir.join(format!("got-{number}"));
            let mut robot = Self { sftp, number, files: server.files.clone(), got };
            // Until `sshd` listens, connections are refused.
            match robot.finish(&[]) {
                Ok(()) => return Ok(robot),
                Err(error) if Instant::now() > deadline => return Err(error),
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        }
    }

    /// Lets it carry out commands, and returns when it has.
    fn finish(&mut self, commands: &[String]) -> Result<()> {
        /// A command that asks nobody, and what it prints.
        const MARK: (&str, &str) = ("lpwd", "Local working directory");
        for command in commands {
            self.sftp.tell(command)?;
        }
        self.sftp.tell(MARK.0)?;
        while !self.sftp.line(STEP_MAX)?.starts_with(MARK.1) {}
        Ok(())
    }

    /// Puts its image and asks for its action until it is there.
    fn step(&mut self, step: usize, image: &Path) -> Result<()> {
        let number = self.number;
        let deadline = Instant::now() + STEP_MAX;
        let there = self.files.join(format!("image-{number}-{step}"));
        self.finish(&[format!("put {} {}", image.display(), there.display())])?;
        let action = self.files.join(format!("action-{number}-{step}"));
        // The minus: that there is no such file yet is no reason to end.
        let get = [format!("-get {} {}", action.display(), self.got.display())];
        loop {
            self.finish(&get)?;
            match fs::remove_file(&self.got) {
                Ok(()) => break,
                Err(error) if error.kind() != ErrorKind::NotFound => return Err(error.into()),
                Err(_) => {
                    ensure!(Instant::now() < deadline, "robot {number} has no action after {STEP_MAX:?}")
                }
            }
        }
        // It is the server's disk; what is left there costs no step anything.
        Ok(fs::remove_file(&action)?)
    }
}
