/* The yardstick of `benchmark.py speed`: the closed loop of the perturbed chain of order 3 with the reference policy, by hand.
 * x' = ((1 + a1) x2, (1 + a2) x3, u + |x|^2), y_d = sin t, RK4 under zero-order hold; prints ns per control step and y(T). */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double clip(double v, double limit) { return fmin(fmax(v, -limit), limit); }

static void field(const double *x, double a1, double a2, double u, double *d) {
    d[0] = (1 + a1) * x[1];
    d[1] = (1 + a2) * x[2];
    d[2] = u + x[0] * x[0] + x[1] * x[1] + x[2] * x[2];
}

/* argv: dt, steps, substeps, episodes, then k (3), k_tilde (3), c (3), c'E (3), c'Phi (3), c'Psi, E (9), rho, margin, limit */
int main(int argc, char **argv) {
    if (argc != 33) return 2;
    double p[32];
    for (int i = 1; i < argc; i++) p[i - 1] = atof(argv[i]);
    const double dt = p[0], *k = p + 4, *kt = p + 7, *c = p + 10, *cE = p + 13, *cPhi = p + 16, b = p[19], *E = p + 20;
    const double rho = p[29], margin = p[30], limit = p[31], rate = (1 - rho) / (1 + rho), h = dt / p[2];
    const int steps = (int)p[1], substeps = (int)p[2], episodes = (int)p[3];
    double sum = 0, last = 0;
    struct timespec t0, t1;
    clock_gettime(CLOCK_MONOTONIC, &t0);
    for (int episode = 0; episode < episodes; episode++) {
        const double a1 = 0.5, a2 = -0.5;
        double x[3] = {1, 0, 0}, es[3], d = 0, predicted = 0, base_last = 0, Gamma_last = 0;
        for (int n = 0; n < steps; n++) {
            const double t = n * dt, yd[4] = {sin(t), cos(t), -sin(t), -cos(t)};
            const double z[3] = {x[0], (1 + a1) * x[1], (1 + a1) * (1 + a2) * x[2]};
            double e[3], omega = yd[3], v = 0, s = 0, a = 0;
            if (n == 0) for (int i = 0; i < 3; i++) es[i] = z[i] - yd[i];
            for (int i = 0; i < 3; i++) {
                e[i] = z[i] - yd[i] - es[i];
                omega -= k[i] * es[i];
                v -= kt[i] * e[i];
                s += c[i] * e[i];
                a += cPhi[i] * (z[i] - yd[i]) - cE[i] * es[i];
            }
            double base = omega + v, base_now = base;
            double Gamma = margin * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + rho / (1 - rho) * fabs(base)), Gamma_now = Gamma;
            if (n > 0) {
                base += 0.5 * (base - base_last);
                Gamma = fmax(Gamma + 0.5 * (Gamma - Gamma_last), 0);
                d = clip(d + rate * ((s - predicted) / b - d), Gamma);
            }
            base_last = base_now;
            Gamma_last = Gamma_now;
            a += b * (base - yd[3]);
            const double ah = a + b * d, v_eq = (s - ah) / b;
            double vL = -clip(ah / b, Gamma);
            if (s * v_eq > 0 && fabs(v_eq) > Gamma)
                vL = copysign(1, s) * Gamma * (1 - 2 * fmin(fabs(s) / (b * (fabs(v_eq) + Gamma)), 1));
            const double u = clip(base + vL, limit);
            predicted = a + b * (u - base);
            double next[3];
            for (int i = 0; i < 3; i++) next[i] = E[3 * i] * es[0] + E[3 * i + 1] * es[1] + E[3 * i + 2] * es[2];
            for (int i = 0; i < 3; i++) es[i] = next[i];
            for (int m = 0; m < substeps; m++) {
                double k1[3], k2[3], k3[3], k4[3], y[3];
                field(x, a1, a2, u, k1);
                for (int i = 0; i < 3; i++) y[i] = x[i] + 0.5 * h * k1[i];
                field(y, a1, a2, u, k2);
                for (int i = 0; i < 3; i++) y[i] = x[i] + 0.5 * h * k2[i];
                field(y, a1, a2, u, k3);
                for (int i = 0; i < 3; i++) y[i] = x[i] + h * k3[i];
                field(y, a1, a2, u, k4);
                for (int i = 0; i < 3; i++) x[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
            }
            sum += fabs(x[0] - sin(t + dt)) * dt;
        }
        last = x[0];
    }
    clock_gettime(CLOCK_MONOTONIC, &t1);
    printf("%.3f %.12f %.12f\n", ((t1.tv_sec - t0.tv_sec) * 1e9 + (t1.tv_nsec - t0.tv_nsec)) / ((double)steps * episodes), last, sum / episodes);
    return 0;
}
