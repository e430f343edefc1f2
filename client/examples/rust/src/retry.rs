//! When to open a stream again.

use std::time::{Duration, SystemTime};

use tonic::{Code, Status};
use tonic_types::StatusExt;

const ATTEMPTS: u32 = 10;

/// How long to wait before the stream is opened again; none if that is of no use.
pub fn wait_before_retry(error: &Status, attempt: u32) -> Option<Duration> {
    if attempt > ATTEMPTS {
        return None;
    }
    if let Some(delay) = error
        .get_details_retry_info()
        .and_then(|info| info.retry_delay)
    {
        return Some(delay);
    }
    let lost = match error.code() {
        Code::Unavailable => true,
        // Tonic reports UNKNOWN where a connection broke, and CANCELLED where it was
        // closed before it was made. What the server reports carries an ErrorInfo.
        Code::Internal | Code::Unknown | Code::Cancelled => {
            error.get_details_error_info().is_none()
        }
        _ => false,
    };
    let longest = Duration::from_millis((100 << attempt).min(2000));
    lost.then(|| longest.mul_f64(0.5 + 0.5 * fraction()))
}

/// A number in [0, 1) that differs from client to client, so that not all come back at
/// once.
fn fraction() -> f64 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    f64::from(now.unwrap_or_default().subsec_nanos() % 1_000_000) / 1e6
}
