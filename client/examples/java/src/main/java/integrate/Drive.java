package integrate;

import com.google.protobuf.Timestamp;
import java.io.IOException;
import java.nio.file.Files;
import java.nio.file.Path;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.function.ToDoubleFunction;
import revisit.v1.Covariance;
import revisit.v1.CovarianceForm;
import revisit.v1.LocalPosition;
import revisit.v1.Pose;
import revisit.v1.PoseColumns;

/** Reads the file of a drive. */
final class Drive {
  private Drive() {}

  /** Reads the poses, which number from 1 in the order of the file. */
  static List<Pose> read(Path path) throws IOException {
    List<String> lines = Files.readAllLines(path);
    List<String> names = Arrays.asList(lines.get(0).split(","));
    List<Pose> poses = new ArrayList<>();
    for (int line = 1; line < lines.size(); ++line) {
      String[] fields = lines.get(line).split(",");
      poses.add(makePose(line, name -> Double.parseDouble(fields[names.indexOf(name)])));
    }
    return poses;
  }

  private static Pose makePose(long sequence, ToDoubleFunction<String> column) {
    double time = column.applyAsDouble("t_s");
    long seconds = (long) Math.floor(time);
    Covariance.Builder covariance =
        Covariance.newBuilder().setForm(CovarianceForm.COVARIANCE_FORM_PLANAR_6);
    for (String name : List.of("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")) {
      covariance.addValues(column.applyAsDouble(name));
    }
    return Pose.newBuilder()
        .setSequence(sequence)
        .setStamp(
            Timestamp.newBuilder()
                .setSeconds(seconds)
                .setNanos((int) Math.round((time - seconds) * 1e9)))
        .setLocal(
            LocalPosition.newBuilder()
                .setXMeters(column.applyAsDouble("est_x"))
                .setYMeters(column.applyAsDouble("est_y")))
        .setHeadingRadians(column.applyAsDouble("est_yaw"))
        .setCovariance(covariance)
        .build();
  }

  /**
   * The poses as columns, which take less to send and to read. All poses of this drive have the
   * same fields, or they would be messages.
   */
  static PoseColumns columnsOf(List<Pose> poses) {
    PoseColumns.Builder columns =
        PoseColumns.newBuilder()
            .setFirstSequence(poses.get(0).getSequence())
            .setPoseCount(poses.size())
            .setFirstStamp(poses.get(0).getStamp())
            .setCovarianceForm(CovarianceForm.COVARIANCE_FORM_PLANAR_6);
    for (int i = 0; i < poses.size(); ++i) {
      Pose pose = poses.get(i);
      if (i > 0) {
        columns.addStampStepNanos(
            nanosecondsOf(pose.getStamp()) - nanosecondsOf(poses.get(i - 1).getStamp()));
      }
      columns
          .addXMeters(pose.getLocal().getXMeters())
          .addYMeters(pose.getLocal().getYMeters())
          .addHeadingRadians(pose.getHeadingRadians())
          .addAllCovariances(pose.getCovariance().getValuesList());
    }
    return columns.build();
  }

  private static long nanosecondsOf(Timestamp stamp) {
    return stamp.getSeconds() * 1_000_000_000 + stamp.getNanos();
  }
}
