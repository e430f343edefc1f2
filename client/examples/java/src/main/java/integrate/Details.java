package integrate;

import com.google.protobuf.Any;
import com.google.protobuf.InvalidProtocolBufferException;
import com.google.protobuf.Message;
import com.google.rpc.BadRequest;
import com.google.rpc.ErrorInfo;
import com.google.rpc.RetryInfo;
import io.grpc.Status;
import io.grpc.StatusException;
import io.grpc.protobuf.StatusProto;
import java.time.Duration;
import java.util.Optional;
import java.util.concurrent.ThreadLocalRandom;

/**
 * What an error of revisit carries. Each may be missing, and all are where the error comes from
 * the transport.
 */
record Details(
    Optional<ErrorInfo> info, Optional<BadRequest> badRequest, Optional<RetryInfo> retry) {
  private static final int ATTEMPTS = 10;

  static Details of(StatusException error) {
    com.google.rpc.Status status = StatusProto.fromThrowable(error);
    return new Details(
        find(status, ErrorInfo.class), find(status, BadRequest.class),
        find(status, RetryInfo.class));
  }

  private static <T extends Message> Optional<T> find(com.google.rpc.Status status, Class<T> type) {
    try {
      for (Any detail : status.getDetailsList()) {
        if (detail.is(type)) {
          return Optional.of(detail.unpack(type));
        }
      }
    } catch (InvalidProtocolBufferException malformed) {
      // As good as none.
    }
    return Optional.empty();
  }

  /** Returns how long to wait before the stream is opened again; empty if that is of no use. */
  static Optional<Duration> waitBeforeRetry(StatusException error, int attempt) {
    if (attempt > ATTEMPTS) {
      return Optional.empty();
    }
    Details details = of(error);
    if (details.retry.isPresent()) {
      com.google.protobuf.Duration delay = details.retry.get().getRetryDelay();
      return Optional.of(Duration.ofSeconds(delay.getSeconds(), delay.getNanos()));
    }
    Status.Code code = error.getStatus().getCode();
    boolean lost =
        code == Status.Code.UNAVAILABLE
            || (code == Status.Code.INTERNAL && details.info.isEmpty());
    double longest = Math.min(2000, 100 * Math.pow(2, attempt));
    return lost
        ? Optional.of(
            Duration.ofMillis((long) ThreadLocalRandom.current().nextDouble(longest / 2, longest)))
        : Optional.empty();
  }
}
