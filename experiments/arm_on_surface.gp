# Mean absolute error on both kinds of test against the number of points; the published ones dashed; the floor that noise leaves.
file = dir . '/arm_on_surface.csv'
set multiplot layout 1, 2 margins 0.06, 0.99, 0.12, 0.90 spacing 0.05
set logscale xy
set grid lc rgb '#eeeeee'
set xlabel 'points'
set key top right noenhanced
floor = 0.1*sqrt(2/pi)
is(m) = strcol('method') eq m
array methods[5] = ['GP', 'GP wide', 'GP2', 'force', 'force + known F']
array colours[5] = [0xd95f02, 0xe6ab02, 0x1f77b4, 0x7570b3, 0x1b9e77]
array places[2] = ['blocks', 'independent']
array titles[2] = ['on stretches of the training motion', 'on another motion']
do for [p = 1:2] {
  set title titles[p]
  if (p == 1) { set ylabel 'mean absolute error [rad/s²]' } else { unset ylabel }
  plot for [m = 1:5] file using (is(methods[m]) ? column('n') : NaN):'mae_'.places[p] with linespoints lw 2 pt 7 ps 0.6 lc rgb colours[m] title methods[m], \
       for [m = 1:5] file using (is(methods[m]) ? column('n') : NaN):'published_mae' with lines dt 2 lc rgb colours[m] notitle, \
       floor with lines dt 3 lc rgb '#888888' title 'noise'
}
unset multiplot
