// Rows as a node stores them to rows as they are splatted: activated, and where they are in boxes, placed in the world.
#pragma once
#include <omp.h>

#include <algorithm>
#include <cstring>
#include <vector>

#include "exponential.hpp"
#include "placement.hpp"

namespace SPLAT_VARIANT {

// Rows are worked in parts that do not depend on the number of threads, so that neither do the sums over rows.
inline int64_t rows_of_part(int64_t rows) {
  constexpr int64_t least = 1024, most_parts = 64;
  const int64_t even = (rows + most_parts - 1) / most_parts;
  return even > least ? even : least;
}

template <class T>
struct StoredRows {
  int64_t count;
  T limit;
  const T *means, *log_scales, *quaternions, *logits, *multipliers;
  const int64_t* instances;
  const T *turns, *shifts;  // quaternions and translations of the instances
  const uint8_t* present;
  explicit StoredRows(const RawRows& r)
      : count(r.count), limit(T(r.logit_limit)),
        means(static_cast<const T*>(r.means)), log_scales(static_cast<const T*>(r.log_scales)),
        quaternions(static_cast<const T*>(r.quaternions)), logits(static_cast<const T*>(r.opacity_logits)),
        multipliers(static_cast<const T*>(r.multipliers)), instances(r.instances),
        turns(static_cast<const T*>(r.pose_quaternions)), shifts(static_cast<const T*>(r.pose_translations)),
        present(r.present) {}
  // What scales and opacities, and what opacities alone are multiplied with.
  T multiplier(int64_t row) const { return multipliers ? multipliers[row] : T(1); }
  T presence(int64_t row) const { return instances ? T(present[instances[row]]) : T(1); }
};

template <class T>
inline void scales_of(const StoredRows<T>& in, int64_t first, int64_t count, T* out) {
  map_lanes(in.log_scales + 3 * first, out, 3 * count, [](const Lanes<T>& x) { return exponential(x); });
}

// NaN passes the limits, so that it shows.
template <class T>
inline void opacities_of(const StoredRows<T>& in, int64_t first, int64_t count, T* out) {
  const T limit = in.limit;
  map_lanes(in.logits + first, out, count, [limit](const Lanes<T>& x) {
    const Lanes<T> below = x > limit ? same(limit) : x;
    return 1 / (1 + exponential(-(below < -limit ? same(-limit) : below)));
  });
}

template <class T>
inline std::vector<Placement<T>> instance_poses(const RawRows& r, const StoredRows<T>& in) {
  std::vector<Placement<T>> poses(r.num_instances);  // 0 without poses
  for (size_t i = 0; i < poses.size(); ++i) rotation_from_quaternion(in.turns + 4 * i, poses[i]);
  return poses;
}

// The Hamilton product, and with `a` or `b` conjugated its transposes.
template <class T>
inline void multiply(const T* a, const T* b, T* out) {
  out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

template <class T>
inline void place_row(const StoredRows<T>& in, const std::vector<Placement<T>>& poses, int64_t row, T* mean,
                      T* quaternion) {
  const int64_t i = in.instances[row];
  const T* local = in.means + 3 * row;
  const Vector<T> turned = poses[i].rotation * Vector<T>{local[0], local[1], local[2]};
  mean[0] = turned.x + in.shifts[3 * i], mean[1] = turned.y + in.shifts[3 * i + 1];
  mean[2] = turned.z + in.shifts[3 * i + 2];
  multiply(in.turns + 4 * i, in.quaternions + 4 * row, quaternion);
}

template <class T>
void activate(const RawRows& r, const ActiveRows& out) {
  const StoredRows<T> in(r);
  const auto poses = instance_poses(r, in);
  T *means = static_cast<T*>(out.means), *quaternions = static_cast<T*>(out.quaternions);
  T *scales = static_cast<T*>(out.scales), *opacities = static_cast<T*>(out.opacities);
  const int64_t part = rows_of_part(in.count);
#pragma omp parallel for num_threads(r.threads) schedule(static)
  for (int64_t first = 0; first < in.count; first += part) {
    const int64_t last = std::min(first + part, in.count);
    scales_of(in, first, last - first, scales + 3 * first);
    opacities_of(in, first, last - first, opacities + first);
    if (in.multipliers)
      for (int64_t row = first; row < last; ++row) {
        for (int c = 0; c < 3; ++c) scales[3 * row + c] *= in.multipliers[row];
        opacities[row] *= in.multipliers[row];
      }
    if (in.instances)
      for (int64_t row = first; row < last; ++row) {
        opacities[row] *= in.presence(row);
        place_row(in, poses, row, means + 3 * row, quaternions + 4 * row);
      }
    else {
      std::memcpy(means + 3 * first, in.means + 3 * first, 3 * (last - first) * sizeof(T));
      std::memcpy(quaternions + 4 * first, in.quaternions + 4 * first, 4 * (last - first) * sizeof(T));
    }
  }
}

// Sums over the rows of an instance: gradients of its translation, of its rotation matrix, and of its quaternion as a
// factor of the rows' own.
struct PoseSums {
  double shift[3] = {}, rotation[9] = {}, turn[4] = {};
  void add(const PoseSums& other) {
    for (int k = 0; k < 3; ++k) shift[k] += other.shift[k];
    for (int k = 0; k < 9; ++k) rotation[k] += other.rotation[k];
    for (int k = 0; k < 4; ++k) turn[k] += other.turn[k];
  }
};

template <class T>
inline void place_row_backward(const StoredRows<T>& in, const std::vector<Placement<T>>& poses, int64_t row,
                               const T* v_mean, const T* v_quaternion, const RawGradients& out, PoseSums& sums) {
  const int64_t i = in.instances[row];
  const T *local = in.means + 3 * row, *a = in.turns + 4 * i, *b = in.quaternions + 4 * row;
  const T a_conjugate[4] = {a[0], -a[1], -a[2], -a[3]}, b_conjugate[4] = {b[0], -b[1], -b[2], -b[3]};
  const Vector<T> back = transposed(poses[i].rotation, Vector<T>{v_mean[0], v_mean[1], v_mean[2]});
  T* v_local = static_cast<T*>(out.means) + 3 * row;
  v_local[0] = back.x, v_local[1] = back.y, v_local[2] = back.z;
  multiply(a_conjugate, v_quaternion, static_cast<T*>(out.quaternions) + 4 * row);
  T v_turn[4];
  multiply(v_quaternion, b_conjugate, v_turn);
  for (int k = 0; k < 3; ++k) sums.shift[k] += v_mean[k];
  for (int k = 0; k < 9; ++k) sums.rotation[k] += double(v_mean[k / 3]) * local[k % 3];
  for (int k = 0; k < 4; ++k) sums.turn[k] += v_turn[k];
}

// Of the rows first to last: scales, opacities, and what multiplies both.
template <class T>
inline void activate_rows_backward(const StoredRows<T>& in, int64_t first, int64_t last, const ActiveRows& v,
                                   const RawGradients& out) {
  const T *v_scales = static_cast<const T*>(v.scales), *v_opacities = static_cast<const T*>(v.opacities);
  T *v_logs = static_cast<T*>(out.log_scales), *v_logits = static_cast<T*>(out.opacity_logits);
  T* v_multipliers = static_cast<T*>(out.multipliers);
  scales_of(in, first, last - first, v_logs + 3 * first);
  opacities_of(in, first, last - first, v_logits + first);
  for (int64_t row = first; row < last; ++row) {
    const T multiplier = in.multiplier(row), presence = in.presence(row), opacity = v_logits[row];
    T v_multiplier = v_opacities[row] * opacity * presence;
    for (int64_t k = 3 * row; k < 3 * row + 3; ++k) {
      const T along = v_scales[k] * v_logs[k];
      v_multiplier += along, v_logs[k] = along * multiplier;
    }
    if (v_multipliers) v_multipliers[row] = v_multiplier;
    const bool held = in.logits[row] > in.limit || in.logits[row] < -in.limit;
    v_logits[row] = held ? T(0) : v_opacities[row] * multiplier * presence * opacity * (1 - opacity);
  }
}

template <class T>
void activate_backward(const RawRows& r, const ActiveRows& v, const RawGradients& out) {
  const StoredRows<T> in(r);
  const auto poses = instance_poses(r, in);
  const T *v_means = static_cast<const T*>(v.means), *v_quaternions = static_cast<const T*>(v.quaternions);
  const int64_t part = rows_of_part(in.count), parts = (in.count + part - 1) / part, instances = poses.size();
  std::vector<PoseSums> sums(parts * instances);
#pragma omp parallel for num_threads(r.threads) schedule(static)
  for (int64_t k = 0; k < parts; ++k) {
    const int64_t first = k * part, last = std::min(first + part, in.count);
    activate_rows_backward(in, first, last, v, out);
    if (in.instances)
      for (int64_t row = first; row < last; ++row)
        place_row_backward(in, poses, row, v_means + 3 * row, v_quaternions + 4 * row, out,
                           sums[k * instances + in.instances[row]]);
  }
  T *v_shifts = static_cast<T*>(out.pose_translations), *v_turns = static_cast<T*>(out.pose_quaternions);
  for (int64_t i = 0; i < instances; ++i) {
    PoseSums sum;
    for (int64_t k = 0; k < parts; ++k) sum.add(sums[k * instances + i]);
    Matrix<T> v_rotation;
    for (int k = 0; k < 3; ++k)
      v_rotation.rows[k] = {T(sum.rotation[3 * k]), T(sum.rotation[3 * k + 1]), T(sum.rotation[3 * k + 2])};
    quaternion_backward(poses[i], v_rotation, v_turns + 4 * i);
    for (int k = 0; k < 4; ++k) v_turns[4 * i + k] += T(sum.turn[k]);
    for (int k = 0; k < 3; ++k) v_shifts[3 * i + k] = T(sum.shift[k]);
  }
}

}  // namespace SPLAT_VARIANT
