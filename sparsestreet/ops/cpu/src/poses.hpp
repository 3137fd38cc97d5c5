// Where boxes are at a time: their keyframes with learned corrections, interpolated (geometry/trajectories.py).
#pragma once
#include <algorithm>

#include "dual.hpp"
#include "kernels.h"

namespace SPLAT_VARIANT {

// Rotation vectors of the corrections at the lower and at the upper keyframe.
constexpr int POSE_INPUTS = 6;
using PoseDual = Dual<POSE_INPUTS>;

struct Rotation {
  PoseDual w, x, y, z;
};
inline Rotation operator*(const Rotation& a, const Rotation& b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
inline Rotation operator*(const PoseDual& k, const Rotation& a) { return {k * a.w, k * a.x, k * a.y, k * a.z}; }
inline Rotation operator+(const Rotation& a, const Rotation& b) { return {a.w + b.w, a.x + b.x, a.y + b.y, a.z + b.z}; }
inline PoseDual dot(const Rotation& a, const Rotation& b) { return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z; }
inline Rotation unit(const Rotation& a) { return inverse(square_root(dot(a, a))) * a; }

// exp of half the rotation vector; near zero by its series, where a length has no derivative.
inline Rotation from_rotation_vector(const PoseDual* v) {
  const PoseDual x = 0.5 * v[0], y = 0.5 * v[1], z = 0.5 * v[2], squared = x * x + y * y + z * z;
  PoseDual sinc, cosines;
  if (squared.value < 1e-6) {
    sinc = PoseDual(1) - 1.0 / 6 * squared, cosines = PoseDual(1) - 0.5 * squared + 1.0 / 24 * (squared * squared);
  } else {
    const PoseDual angle = square_root(squared);
    sinc = sine(angle) / angle, cosines = cosine(angle);
  }
  return {cosines, sinc * x, sinc * y, sinc * z};
}

// The rotation at a fraction of the shorter arc from a to b, both unit; near ones linearly.
inline Rotation between(const Rotation& a, const Rotation& b, double fraction) {
  PoseDual along = dot(a, b);
  const double sign = along.value < 0 ? -1 : 1;
  along = sign * along;
  PoseDual of_a(1 - fraction), of_b(fraction);
  if (along.value <= 0.9995) {
    const PoseDual angle = arc_cosine(along), scale = inverse(sine(angle));
    of_a = sine((1 - fraction) * angle) * scale, of_b = sine(fraction * angle) * scale;
  }
  return unit(of_a * a + sign * of_b * b);
}

struct Bracket {
  int64_t lower, upper;
  double fraction;
  bool present;
};

// Compared in T, in which the times of the table were rounded.
template <class T>
inline Bracket bracket(const Keyframes& in, int64_t instance) {
  const T* times = static_cast<const T*>(in.times) + instance * in.length;
  const T* span = static_cast<const T*>(in.spans) + 2 * instance;
  const uint8_t* valid = in.valid + instance * in.length;
  const T time = T(in.time);
  int64_t count = 0, before = 0;
  double nearest = HUGE_VAL;
  for (int64_t k = 0; k < in.length; ++k) {
    if (!valid[k]) continue;
    ++count, before += times[k] <= time;
    nearest = std::min(nearest, std::abs(double(times[k]) - time));
  }
  const int64_t zero = 0;
  Bracket at;
  at.lower = std::min(std::max(before - 1, zero), std::max(count - 2, zero));
  at.upper = std::max(std::min(at.lower + 1, count - 1), zero);
  const double inside = std::min(std::max(time, span[0]), span[1]);
  const double step = double(times[at.upper]) - times[at.lower];
  at.fraction = at.upper > at.lower ? (inside - times[at.lower]) / step : 0;
  at.present = nearest <= in.max_gap + in.tolerance && std::abs(inside - time) <= in.tolerance;
  return at;
}

template <class T>
inline Rotation corrected(const Keyframes& in, int64_t keyframe, int first) {
  const T *q = static_cast<const T*>(in.quaternions) + 4 * keyframe;
  const T* vector = static_cast<const T*>(in.rotation_deltas) + 3 * keyframe;
  PoseDual v[3];
  for (int k = 0; k < 3; ++k) v[k] = PoseDual(vector[k]), v[k].d[first + k] = 1;
  return unit(Rotation{double(q[0]), double(q[1]), double(q[2]), double(q[3])} * from_rotation_vector(v));
}

template <class T>
void poses(const Keyframes& in, const InstancePoses& out) {
  const T *centers = static_cast<const T*>(in.translations), *shifts = static_cast<const T*>(in.translation_deltas);
  for (int64_t i = 0; i < in.instances; ++i) {
    const Bracket at = bracket<T>(in, i);
    const int64_t lower = i * in.length + at.lower, upper = i * in.length + at.upper;
    const Rotation r = between(corrected<T>(in, lower, 0), corrected<T>(in, upper, 3), at.fraction);
    const PoseDual* q[4] = {&r.w, &r.x, &r.y, &r.z};
    for (int k = 0; k < 4; ++k) {
      static_cast<T*>(out.quaternions)[4 * i + k] = T(q[k]->value);
      std::copy(q[k]->d, q[k]->d + POSE_INPUTS, out.slopes + POSE_INPUTS * (4 * i + k));
    }
    for (int k = 0; k < 3; ++k) {
      const double a = double(centers[3 * lower + k]) + shifts[3 * lower + k];
      const double b = double(centers[3 * upper + k]) + shifts[3 * upper + k];
      static_cast<T*>(out.translations)[3 * i + k] = T(a + at.fraction * (b - a));
    }
    out.present[i] = at.present, out.fractions[i] = at.fraction;
    out.keyframes[2 * i] = lower, out.keyframes[2 * i + 1] = upper;
  }
}

// Adds to the gradients of the corrections, which are zero before.
template <class T>
void poses_backward(int64_t instances, const InstancePoses& of, const void* quaternions, const void* translations,
                    void* rotation_deltas, void* translation_deltas) {
  const T *v_turn = static_cast<const T*>(quaternions), *v_shift = static_cast<const T*>(translations);
  T *turns = static_cast<T*>(rotation_deltas), *shifts = static_cast<T*>(translation_deltas);
  for (int64_t i = 0; i < instances; ++i)
    for (int end = 0; end < 2; ++end) {
      const int64_t keyframe = of.keyframes[2 * i + end];
      const double share = end ? of.fractions[i] : 1 - of.fractions[i];
      for (int k = 0; k < 3; ++k) {
        double sum = 0;
        for (int c = 0; c < 4; ++c) sum += v_turn[4 * i + c] * of.slopes[POSE_INPUTS * (4 * i + c) + 3 * end + k];
        turns[3 * keyframe + k] += T(sum), shifts[3 * keyframe + k] += T(share * v_shift[3 * i + k]);
      }
    }
}

}  // namespace SPLAT_VARIANT
