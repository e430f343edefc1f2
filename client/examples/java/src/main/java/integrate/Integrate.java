package integrate;

import com.google.rpc.BadRequest;
import com.google.rpc.ErrorInfo;
import io.grpc.Grpc;
import io.grpc.InsecureChannelCredentials;
import io.grpc.ManagedChannel;
import io.grpc.StatusException;
import java.nio.file.Path;
import java.util.Comparator;
import java.util.List;
import java.util.concurrent.TimeUnit;
import revisit.v1.AddLoopClosureRequest;
import revisit.v1.AppendPosesRequest;
import revisit.v1.Candidate;
import revisit.v1.CreateVehicleRequest;
import revisit.v1.LoopClosure;
import revisit.v1.Pose;
import revisit.v1.PoseGraphServiceGrpc;
import revisit.v1.PoseGraphServiceGrpc.PoseGraphServiceBlockingV2Stub;
import revisit.v1.Vehicle;

/**
 * Streams a drive to revisit, prints where the vehicle has been before, and confirms one of these
 * places. Arguments: address, file, id of the vehicle.
 *
 * <p>With two arguments, address and a file that keeps the cursor, it prints what becomes of stored
 * candidates instead.
 */
public final class Integrate {
  private Integrate() {}

  public static void main(String[] arguments) throws Exception {
    if (arguments.length != 2 && arguments.length != 3) {
      System.err.println(
          "usage: Integrate ADDRESS FILE VEHICLE_ID | Integrate ADDRESS CURSOR_FILE");
      System.exit(64);
    }
    Path path = Path.of(arguments[1]);
    ManagedChannel channel =
        Grpc.newChannelBuilder(arguments[0], InsecureChannelCredentials.create())
            // A connection whose other end has vanished is noticed after half a minute.
            .keepAliveTime(20, TimeUnit.SECONDS)
            .keepAliveTimeout(10, TimeUnit.SECONDS)
            .build();
    PoseGraphServiceBlockingV2Stub stub = PoseGraphServiceGrpc.newBlockingV2Stub(channel);
    try {
      if (arguments.length == 2) {
        new CandidateWatcher(stub, path).run();
      } else {
        run(stub, Drive.read(path), arguments[2]);
      }
    } finally {
      channel.shutdownNow().awaitTermination(5, TimeUnit.SECONDS);
    }
  }

  private static void run(PoseGraphServiceBlockingV2Stub stub, List<Pose> poses, String vehicleId)
      throws StatusException, InterruptedException {
    Vehicle vehicle =
        stub.createVehicle(CreateVehicleRequest.newBuilder().setVehicleId(vehicleId).build())
            .getVehicle();
    System.out.printf("vehicle: %s, uid %s%n", vehicle.getName(), vehicle.getUid());
    List<Candidate> accepted = new PoseStreamer(stub, vehicle, poses).run();
    System.out.printf("durable: all %d poses%n", poses.size());
    if (!accepted.isEmpty()) {
      confirm(stub, vehicle, accepted);
    }
    showError(stub, vehicle, poses.get(poses.size() - 1));
  }

  /**
   * Says of the most probable candidate that it is the same place, as a verifier would after it
   * compared images or scans.
   */
  private static void confirm(
      PoseGraphServiceBlockingV2Stub stub, Vehicle vehicle, List<Candidate> accepted)
      throws StatusException {
    Candidate best =
        accepted.stream().max(Comparator.comparingDouble(Candidate::getProbability)).get();
    LoopClosure closure =
        stub.addLoopClosure(
                AddLoopClosureRequest.newBuilder()
                    .setParent(vehicle.getName())
                    .setLoopClosure(
                        LoopClosure.newBuilder()
                            .setQuerySequence(best.getQuery().getSequence())
                            .setMatchedSequence(best.getMatched().getSequence()))
                    .build())
            .getLoopClosure();
    System.out.printf("confirmed: %s%n", closure.getName());
  }

  /**
   * Sends a pose with a variance below 0, which is refused and changes nothing, and prints all
   * that the error says.
   */
  private static void showError(PoseGraphServiceBlockingV2Stub stub, Vehicle vehicle, Pose last) {
    Pose.Builder pose = last.toBuilder().setSequence(last.getSequence() + 1);
    pose.getCovarianceBuilder().setValues(0, -1);
    try {
      stub.appendPoses(
          AppendPosesRequest.newBuilder()
              .setVehicle(vehicle.getName())
              .setVehicleUid(vehicle.getUid())
              .addPoses(pose)
              .build());
    } catch (StatusException error) {
      Details details = Details.of(error);
      ErrorInfo info = details.info().orElse(ErrorInfo.getDefaultInstance());
      System.out.printf(
          "refused: %s, reason %s of %s, request %s: %s%n",
          error.getStatus().getCode(), info.getReason(), info.getDomain(),
          info.getMetadataMap().get("request_id"), error.getStatus().getDescription());
      for (BadRequest.FieldViolation violation :
          details.badRequest().orElse(BadRequest.getDefaultInstance()).getFieldViolationsList()) {
        System.out.printf("  %s: %s%n", violation.getField(), violation.getDescription());
      }
    }
  }
}
